// One loop on several threads: each goes through some of the packs, and first adds to private memory what several
// threads add to the same rows. The sums do not depend on which thread is faster.
#pragma once

#include "gather_scatter.h"

namespace tc {

template <class R>
struct ParallelReduce : GatherScatter<R> {
    using typename GatherScatter<R>::P;
    using GatherScatter<R>::L, GatherScatter<R>::program, GatherScatter<R>::code, GatherScatter<R>::index;
    using GatherScatter<R>::row, GatherScatter<R>::contact_points, GatherScatter<R>::tables;
    double ops_per_item = 0;  // approximate operations on numbers

    // Runs f(view, items, first, last) for all items, by threads; a pack has `items_per_pack`.
    template <class F>
    void run_parallel(Scene<R>& s, ItemSpan all, RunMode mode, int items_per_pack, F f) const {
        const int parts = parts_of(s, all);
        if (parts == 1) return f(s.view(), all, 0, all.items);
        for (int m = 1; m < parts; m++) lend_fields(s, s.scratch[m - 1], mode);
        const int packs = (all.items + items_per_pack - 1) / items_per_pack;
        s.team->run(parts, [&](int m) {
            const int first = begin_of(m, parts, packs) * items_per_pack,
                      last = std::min(all.items, begin_of(m + 1, parts, packs) * items_per_pack);
            if (m == 0) return f(s.view(), all, first, last);
            ThreadScratch<R>& scratch = s.scratch[m - 1];
            clear(s, scratch, all, mode, first, last);
            ItemSpan span = all;
            span.picked = scratch.picked.data();
            f(scratch.view(), span, first, last);
        });
        add_accumulators(s, parts);
    }

  private:
    // A loop is divided if it has at least this fraction of the operations that make a thread worth while: the threads
    // exist already.
    static constexpr int MAX_DIVISION = 32;

    // Threads keep to their rows, so that they read mostly what they wrote. Contact points belong to fixed threads.
    int parts_of(const Scene<R>& s, const ItemSpan& all) const {
        if (contact_points == contact_count::active) return s.point_parts;
        return all.items * ops_per_item * s.lanes * MAX_DIVISION >= s.min_ops_per_thread ? s.parts : 1;
    }

    // Whether no two items have the same row in a table.
    static bool is_unique(int table) {
        const int group = CONTACT_ROWS - table - contact_table::point;
        return table == ITEM_ROW || group == contact_table::corners || group == contact_table::activated ||
               group == contact_table::inactive;
    }
    // Calls f(instruction, the scene's memory, the thread's pointer, its accumulator, numbers of a row) for fields that
    // several threads add to.
    template <class F>
    void for_each_accumulated(Scene<R>& s, ThreadScratch<R>& t, RunMode mode, F f) const {
        const auto wanted = mode == RunMode::adjoints ? Opcode::load : Opcode::add;
        for (const Instruction& i : code) {
            if (i.code != wanted || i.is_point_field || is_unique(i.table)) continue;
            const size_t pitch = program.fields[i.field].pitch * s.lanes;
            if (mode != RunMode::adjoints) f(i, s.value[i.field], t.value[i.field], t.values[i.field], pitch);
            else if (s.bar[i.field]) f(i, s.bar[i.field], t.bar[i.field], t.bars[i.field], pitch);
            if (mode == RunMode::tangents) f(i, s.dot[i.field], t.dot[i.field], t.dots[i.field], pitch * s.directions);
        }
    }
    void lend_fields(Scene<R>& s, ThreadScratch<R>& t, RunMode mode) const {
        for (const Instruction& i : code)
            if (i.field >= 0)
                t.value[i.field] = s.value[i.field], t.bar[i.field] = s.bar[i.field], t.dot[i.field] = s.dot[i.field];
        t.used.clear();
        for_each_accumulated(s, t, mode, [&](const Instruction& i, R* target, R*& at, auto& accumulator, size_t pitch) {
            if (at == accumulator.memory.data && at != nullptr) return;  // another instruction has set it
            const size_t size = program.fields[i.field].padded * pitch;
            if (accumulator.memory.size < size) accumulator.memory.reset(size);
            at = accumulator.memory.data, accumulator.target = target, accumulator.low = size, accumulator.high = 0;
            t.used.push_back(&accumulator);
        });
        if (t.picked.size() < tables.size() * L) t.picked.resize(tables.size() * L);
    }
    void clear(Scene<R>& s, ThreadScratch<R>& t, const ItemSpan& all, RunMode mode, int first, int last) const {
        for_each_accumulated(s, t, mode, [&](const Instruction& i, R*, R*&, auto& accumulator, size_t pitch) {
            const auto [low, high] = rows_of(i, all, first, last);
            accumulator.low = std::min(accumulator.low, low * pitch);
            accumulator.high = std::max(accumulator.high, (high + 1) * pitch);
        });
        for (auto* a : t.used) std::fill(a->memory.data + a->low, a->memory.data + a->high, R(0));
    }
    // Adds the accumulators to their targets; every thread does the rows that it has near.
    static void add_accumulators(Scene<R>& s, int parts) {
        bool any = false;
        for (int m = 1; m < parts; m++) any = any || !s.scratch[m - 1].used.empty();
        if (any) s.team->run(parts, [&](int part) { add_part(s, parts, part); });
    }
    static void add_part(Scene<R>& s, int parts, int part) {
        for (int m = 1; m < parts; m++)
            for (auto* a : s.scratch[m - 1].used) {
                const size_t lines = (a->memory.size + LANES<R> - 1) / LANES<R>;
                const size_t low = std::max(a->low, lines * part / parts * LANES<R>);
                const size_t high = std::min(a->high, lines * (part + 1) / parts * LANES<R>);
                for (size_t k = low; k < high; k++) a->target[k] += a->memory.data[k];
            }
    }
    // The first and the last row of some items.
    std::pair<size_t, size_t> rows_of(const Instruction& i, const ItemSpan& all, int first, int last) const {
        if (i.table == SINGLE_ROW) return {0, 0};
        int low = row(i, first, all), high = low;
        if (all.list)
            for (int k = first; k < last; k++)
                low = std::min(low, row(i, k, all)), high = std::max(high, row(i, k, all));
        else {
            const int* at = index(i, all);
            for (int k = first; k < last; k++) low = std::min(low, at[k]), high = std::max(high, at[k]);
        }
        return {size_t(low), size_t(high)};
    }
};

}  // namespace tc
