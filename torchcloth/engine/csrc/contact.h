// Which triangles are near another layer of cloth, and where their points lie on the grid: torchcloth/self_contact.py.
// This stage decides; loops over what it lists do the rest. Nothing is listed for a sheet that is alone.
#pragma once

#include <algorithm>
#include <cmath>

#include "nodes.h"
#include "points.h"
#include "program.h"
#include "search.h"
#include "transfer.h"

namespace tc {

// Rows of Scene::rows and Scene::counts, in the order of engine/parts/contact.py.
enum Listed { POINTS_LIST, ASLEEP_LIST = 13, LISTS = 19 };
enum Counted { POINTS, WOKEN, ASLEEP, COUNTS };

// What one scene remembers.
template <class R>
struct Layers {
    Mask mask, listed;         // triangles that take part, and those of the lists
    Buffer<R> reference;       // positions at the last search
    Points<R> points, woken, asleep;
    Nodes<R> nodes;
    std::vector<Buffer<R>> value, bar, dot;  // by field of the grid
};

template <class R>
struct Contact : Stage<R> {
    const Program<R>& program;
    Search<R> search;
    int x, base;               // fields: positions, lowest node of each point
    std::vector<int> grid;     // fields of the nodes, first the two that are added to, and of the points
    std::vector<R> place;      // [points of a triangle, 3] barycentric
    int chunk;                 // substeps after which the search is repeated anyway: intervals.py
    R spacing, skin;

    Contact(const Program<R>& p) : program(p) { this->again = true; }

    void forward(Scene<R>& s) const override { prepare(s); }
    void replay(Scene<R>& s) const override { prepare(s); }
    void tangent(Scene<R>& s) const override { prepare(s); }
    void reverse(Scene<R>&) const override {}

  private:
    int each() const { return int(place.size()) / 3; }

    void prepare(Scene<R>& s) const {
        if (s.layers == nullptr) start(s);
        Layers<R>& near = *s.layers;
        const Mask before = decide(s, near);
        const bool changed = near.listed != near.mask;
        if (changed) {
            near.points.list(near.mask, true, search.corner, search.triangles, each());
            near.listed = near.mask;
            s.lists_made++;
        }
        list_woken(s, near, before);
        near.asleep.list(near.mask, false, search.corner, s.substep == s.substeps - 1 ? search.triangles : 0, each());
        if (changed) near.points.weigh(place);
        near.nodes.place(near.points, s.value[x], program.fields[x].rows, spacing, changed);
        show(s, near);
        make_room(s, near);
    }

    void start(Scene<R>& s) const {
        s.layers = std::make_shared<Layers<R>>();
        Layers<R>& near = *s.layers;
        near.mask.assign(program.words, 0);
        for (auto* buffers : {&near.value, &near.bar, &near.dot}) buffers->resize(grid.size());
        near.nodes.start(search.triangles * each());
    }

    // Finds the triangles that take part; returns those of the substep before.
    Mask decide(Scene<R>& s, Layers<R>& near) const {
        int32_t* noted = s.masks ? s.masks + s.substep * program.words : nullptr;
        Mask before = near.mask;
        if (s.knows) {
            std::memcpy(near.mask.data(), noted, program.words * sizeof(int32_t));
            if (s.substep > 0) std::memcpy(before.data(), noted - program.words, program.words * sizeof(int32_t));
        } else {
            if (s.substep % chunk == 0 || moved(s, near)) look(s, near);
            if (noted) std::memcpy(noted, near.mask.data(), program.words * sizeof(int32_t));
        }
        return s.substep > 0 ? before : near.mask;
    }
    bool moved(const Scene<R>& s, const Layers<R>& near) const {
        const Quad<R>*now = reinterpret_cast<const Quad<R>*>(s.value[x]), *then = reinterpret_cast<const Quad<R>*>(near.reference.data);
        Quad<R> most(0.0);
        for (int v = 0; v < program.fields[x].rows; v++) {
            const Quad<R> way = abs(now[v] - then[v]);
            most = select(less(most, way), way, most);
        }
        return std::max(most[0], std::max(most[1], most[2])) >= skin / 2;
    }
    void look(const Scene<R>& s, Layers<R>& near) const {
        const R* now = s.value[x];
        near.reference.reset(program.fields[x].size());
        std::copy(now, now + program.fields[x].size(), near.reference.data);
        search.look(now, near.mask);
    }

    void list_woken(Scene<R>& s, Layers<R>& near, const Mask& before) const {
        Mask fresh = near.mask;
        for (size_t w = 0; w < fresh.size(); w++) fresh[w] &= ~before[w];
        const bool any = std::any_of(fresh.begin(), fresh.end(), [](uint32_t w) { return w != 0; });
        near.woken.list(fresh, true, search.corner, any ? search.triangles : 0, each());
    }

    void show(Scene<R>& s, const Layers<R>& near) const {
        near.points.show(&s.rows[POINTS_LIST]), near.woken.show(&s.rows[WOKEN_LIST]), near.asleep.show(&s.rows[ASLEEP_LIST]);
        s.rows[WOKEN_LIST - 1] = near.nodes.around.data();
        s.counts = {near.points.size(), near.woken.size(), near.asleep.size()};
        s.value[base] = const_cast<R*>(reinterpret_cast<const R*>(near.nodes.lowest.data));
    }

    void make_room(Scene<R>& s, Layers<R>& near) const {
        const size_t packed = round_up(near.points.size(), LANES<R>);
        for (size_t i = 0; i < grid.size(); i++) {
            const Field& f = program.fields[grid[i]];
            const size_t count = f.kind == Kind::points ? packed * f.comps : size_t(near.nodes.count()) * ON_BLOCK;
            const bool adds = i < 2;
            s.value[grid[i]] = room(near.value[i], count, adds);
            if (s.bars.size) s.bar[grid[i]] = room(near.bar[i], count, true);
            if (s.dots.size) s.dot[grid[i]] = room(near.dot[i], count * DIRECTIONS, adds);
        }
    }
    static R* room(Buffer<R>& buffer, size_t count, bool clear) {
        if (buffer.size < count) buffer.reset(2 * count);
        if (clear) std::memset(static_cast<void*>(buffer.data), 0, count * sizeof(R));
        return buffer.data;
    }
};

}  // namespace tc
