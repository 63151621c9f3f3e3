// Which triangles are near another layer of cloth, and where their points lie on the grid:
// torchcloth/dynamics/contact/self_contact.py.
// This stage decides; loops over the points that it lists do the rest. A sheet that is alone has no points.
#pragma once

#include <algorithm>
#include <cmath>

#include "contact_points.h"
#include "layer_search.h"
#include "program.h"
#include "sparse_grid.h"
#include "transfer.h"

namespace tc {

// What a scene keeps from substep to substep.
template <class R>
struct ContactState {
    Mask mask, listed_mask;  // active triangles, and those of the lists
    Buffer<R> reference;     // positions at the last search
    ContactPoints<R> points, activated, inactive;
    SparseGrid<R> nodes;
    std::vector<Buffer<R>> value, bar, dot;  // by field of the grid
};

// Calls f(first block, behind the last one) for each part, on the thread that has its points.
template <class R, class F>
void over_blocks(Scene<R>& s, F f) {
    const SparseGrid<R>& nodes = s.contact->nodes;
    if (s.point_parts == 1) return f(0, nodes.count());
    s.team->run(s.point_parts, [&](int m) { f(nodes.part_begin(m), nodes.part_begin(m + 1)); });
}

template <class R>
struct ContactSearch : Stage<R> {
    const Program<R>& program;
    LayerSearch<R> search;
    int x, lowest_node;     // fields: positions, lowest node of each point
    int shift;              // field: where the grid lies, in spacings
    std::vector<int> grid;  // fields of the nodes, first the two that are added to, and of the points
    std::vector<R> place;   // [points of a triangle, 3] barycentric
    int search_interval;    // substeps after which the search is repeated in any case
    R spacing, skin;

    ContactSearch(const Program<R>& p) : program(p) { this->is_replayed = true; }

    bool runs_in_lanes() const override { return false; }
    void forward(Scene<R>& s) const override { prepare(s); }
    void replay(Scene<R>& s) const override { prepare(s); }
    void tangent(Scene<R>& s) const override { prepare(s); }
    void reverse(Scene<R>&) const override {}

  private:
    static constexpr double OPS_PER_POINT = 3e4;  // in all loops over contact; few points are not worth dividing

    int points_per_triangle() const { return int(place.size()) / 3; }

    void prepare(Scene<R>& s) const {
        if (s.contact == nullptr) start(s);
        ContactState<R>& state = *s.contact;
        const Mask before = update_mask(s, state);
        const bool changed = state.listed_mask != state.mask;
        if (changed) {
            state.points.select(state.mask, true, search.corner, search.triangles, points_per_triangle());
            state.listed_mask = state.mask;
            s.contact_version++;
        }
        list_activated(state, before);
        const bool is_last = s.substep == s.substeps - 1;
        state.inactive.select(state.mask, false, search.corner, is_last ? search.triangles : 0, points_per_triangle());
        if (changed) {
            state.points.set_weights(place);
            s.contact_counts[contact_count::active] = state.points.size();
            s.parts = program.parts(s);
            s.point_parts = state.points.size() * OPS_PER_POINT >= s.min_ops_per_thread ? s.parts : 1;
        }
        state.nodes.update(state.points, s.value[x], spacing, s.value[shift], changed, s.point_parts, s.team);
        export_tables(s, state);
        reserve_fields(s, state);
    }

    void start(Scene<R>& s) const {
        s.contact = std::make_shared<ContactState<R>>();
        ContactState<R>& state = *s.contact;
        state.mask.assign(program.mask_words, 0);
        for (auto* buffers : {&state.value, &state.bar, &state.dot}) buffers->resize(grid.size());
        state.nodes.start(search.triangles * points_per_triangle());
    }

    // Updates the mask of active triangles; returns that of the substep before.
    Mask update_mask(Scene<R>& s, ContactState<R>& state) const {
        int32_t* stored = s.masks ? s.masks + s.substep * program.mask_words : nullptr;
        const size_t bytes = program.mask_words * sizeof(int32_t);
        Mask before = state.mask;
        if (s.has_masks) {
            std::memcpy(state.mask.data(), stored, bytes);
            if (s.substep > 0) std::memcpy(before.data(), stored - program.mask_words, bytes);
        } else {
            if (s.substep % search_interval == 0 || has_moved(s, state)) search_layers(s, state);
            if (stored) std::memcpy(stored, state.mask.data(), bytes);
        }
        return s.substep > 0 ? before : state.mask;
    }
    // Whether a vertex has moved by half the skin since the last search.
    bool has_moved(const Scene<R>& s, const ContactState<R>& state) const {
        const Quad<R>* now = reinterpret_cast<const Quad<R>*>(s.value[x]);
        const Quad<R>* reference = reinterpret_cast<const Quad<R>*>(state.reference.data);
        Quad<R> largest(0.0);
        for (int v = 0; v < program.fields[x].rows; v++) largest = larger(largest, abs(now[v] - reference[v]));
        return std::max(largest[0], std::max(largest[1], largest[2])) >= skin / 2;
    }
    void search_layers(const Scene<R>& s, ContactState<R>& state) const {
        const R* now = s.value[x];
        state.reference.reset(program.fields[x].size());
        std::copy(now, now + program.fields[x].size(), state.reference.data);
        search.find_active(now, state.mask, s.parts, s.team);
    }

    void list_activated(ContactState<R>& state, const Mask& before) const {
        Mask fresh = state.mask;
        for (size_t w = 0; w < fresh.size(); w++) fresh[w] &= ~before[w];
        const bool any = std::any_of(fresh.begin(), fresh.end(), [](uint32_t w) { return w != 0; });
        state.activated.select(fresh, true, search.corner, any ? search.triangles : 0, points_per_triangle());
    }

    void export_tables(Scene<R>& s, const ContactState<R>& state) const {
        state.points.export_tables(&s.contact_rows[contact_table::corners]);
        state.activated.export_tables(&s.contact_rows[contact_table::activated]);
        state.inactive.export_tables(&s.contact_rows[contact_table::inactive]);
        s.contact_rows[contact_table::nodes] = state.nodes.blocks_of_point.data();
        s.contact_counts = {state.points.size(), state.activated.size(), state.inactive.size()};
        s.value[lowest_node] = const_cast<R*>(reinterpret_cast<const R*>(state.nodes.lowest_node.data));
    }

    // Sizes the fields of nodes and points, and clears those that are added to.
    void reserve_fields(Scene<R>& s, ContactState<R>& state) const {
        const size_t padded = round_up(state.points.size(), LANES<R>);
        for (size_t i = 0; i < grid.size(); i++) {
            const Field& f = program.fields[grid[i]];
            const bool is_of_points = f.kind == FieldKind::points;
            const size_t count = is_of_points ? padded * f.comps : size_t(state.nodes.count()) * BLOCK_NUMBERS;
            s.value[grid[i]] = reserve(state.value[i], count);
            if (s.bars.size) s.bar[grid[i]] = reserve(state.bar[i], count);
            if (s.dots.size) s.dot[grid[i]] = reserve(state.dot[i], count * s.directions);
            if (is_of_points && s.bars.size) std::fill_n(s.bar[grid[i]], count, R(0));
        }
        over_blocks(s, [&](int first, int last) {
            auto clear = [&](R* field, size_t depth) {
                std::fill(field + first * BLOCK_NUMBERS * depth, field + last * BLOCK_NUMBERS * depth, R(0));
            };
            for (size_t i = 0; i < grid.size(); i++) {
                if (program.fields[grid[i]].kind == FieldKind::points) continue;
                const bool is_added_to = i < 2;
                if (is_added_to) clear(s.value[grid[i]], 1);
                if (s.bars.size) clear(s.bar[grid[i]], 1);
                if (is_added_to && s.dots.size) clear(s.dot[grid[i]], s.directions);
            }
        });
    }
    static R* reserve(Buffer<R>& buffer, size_t count) {
        if (buffer.size < count) buffer.reset(2 * count);
        return buffer.data;
    }
};

}  // namespace tc
