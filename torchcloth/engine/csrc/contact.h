// Which triangles are near another layer of cloth, and where their points lie on the grid: torchcloth/dynamics/contact/self_contact.py.
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

// Of Scene::counts, in the order of engine/lowerings/contact.py.
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

// f(first block, behind the last one) for each part, by the thread that has its points.
template <class R, class F>
void over_blocks(Scene<R>& s, F f) {
    const Nodes<R>& nodes = s.layers->nodes;
    if (s.point_parts == 1) return f(0, nodes.count());
    s.team->run(s.point_parts, [&](int m) { f(nodes.begin(m), nodes.begin(m + 1)); });
}

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
    static constexpr double EACH = 3e4;  // operations of a point in all its loops, and what little is worth dividing

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
        if (changed) {
            near.points.weigh(place);
            s.counts[POINTS] = near.points.size();
            s.parts = program.parts(s);
            s.point_parts = near.points.size() * EACH >= s.worth ? s.parts : 1;
        }
        near.nodes.place(near.points, s.value[x], program.fields[x].rows, spacing, changed, s.point_parts, s.team);
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
        search.look(now, near.mask, s.parts, s.team);
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
            const bool points = f.kind == Kind::points;
            const size_t count = points ? packed * f.comps : size_t(near.nodes.count()) * ON_BLOCK;
            s.value[grid[i]] = room(near.value[i], count);
            if (s.bars.size) s.bar[grid[i]] = room(near.bar[i], count);
            if (s.dots.size) s.dot[grid[i]] = room(near.dot[i], count * s.directions);
            if (points && s.bars.size) std::fill_n(s.bar[grid[i]], count, R(0));
        }
        over_blocks(s, [&](int first, int last) {
            auto clear = [&](R* field, size_t depth) {
                std::fill(field + first * ON_BLOCK * depth, field + last * ON_BLOCK * depth, R(0));
            };
            for (size_t i = 0; i < grid.size(); i++) {
                if (program.fields[grid[i]].kind == Kind::points) continue;
                const bool adds = i < 2;
                if (adds) clear(s.value[grid[i]], 1);
                if (s.bars.size) clear(s.bar[grid[i]], 1);
                if (adds && s.dots.size) clear(s.dot[grid[i]], s.directions);
            }
        });
    }
    static R* room(Buffer<R>& buffer, size_t count) {
        if (buffer.size < count) buffer.reset(2 * count);
        return buffer.data;
    }
};

}  // namespace tc
