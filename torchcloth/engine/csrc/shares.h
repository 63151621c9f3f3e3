// One loop for several threads: each goes through some of the packs, and what they add to the same rows they add to
// memory of their own first. The sums do not depend on which thread is faster.
#pragma once

#include "moves.h"

namespace tc {

enum class Way { value, reverse, tangent };

template <class R>
struct Shares : Moves<R> {
    using typename Moves<R>::P;
    using Moves<R>::L, Moves<R>::program, Moves<R>::code, Moves<R>::index, Moves<R>::row, Moves<R>::counted, Moves<R>::tables;
    double work = 0;  // operations on numbers for an item, about

    // f(view, items, first, last) goes through these items.
    template <class F>
    void share(Scene<R>& s, Span all, Way way, F f) const {
        const int parts = parts_of(s, all);
        if (parts == 1) return f(s.view(), all, 0, all.items);
        for (int m = 1; m < parts; m++) lend(s, s.desks[m - 1], way);
        const int packs = (all.items + L - 1) / L;
        s.team->run(parts, [&](int m) {
            const int first = begin_of(m, parts, packs) * L, last = std::min(all.items, begin_of(m + 1, parts, packs) * L);
            if (m == 0) return f(s.view(), all, first, last);
            Desk<R>& own = s.desks[m - 1];
            clear(s, own, all, way, first, last);
            Span mine = all;
            mine.picked = own.picked.data();
            f(own.view(), mine, first, last);
        });
        add_up(s, parts);
    }

    static constexpr int LITTLE = 32;  // times less than what is worth a thread is worth dividing, once threads are there

  private:
    // Threads keep to their rows: what they read is then mostly what they wrote. Points of contact know to whom they belong.
    int parts_of(const Scene<R>& s, const Span& all) const {
        if (counted == 0) return s.point_parts;
        return all.items * work * LITTLE >= s.worth ? s.parts : 1;
    }

    // No two items have the same row there.
    static bool is_unique(int table) {
        const int list = VARYING - table - OWN_ROW;
        return table == OWN || list == POINTS_LIST || list == WOKEN_LIST || list == ASLEEP_LIST;
    }
    // f(instruction, the scene's memory, a desk's pointers, its shares, numbers of a row) for what several threads add to.
    template <class F>
    void each_sum(Scene<R>& s, Desk<R>& d, Way way, F f) const {
        const auto wanted = way == Way::reverse ? Instruction::load : Instruction::add;
        for (const Instruction& i : code) {
            if (i.code != wanted || i.packed || is_unique(i.table)) continue;
            const size_t pitch = program.fields[i.field].pitch;
            if (way != Way::reverse) f(i, s.value[i.field], d.value[i.field], d.values[i.field], pitch);
            else if (s.bar[i.field]) f(i, s.bar[i.field], d.bar[i.field], d.bars[i.field], pitch);
            if (way == Way::tangent) f(i, s.dot[i.field], d.dot[i.field], d.dots[i.field], pitch * s.directions);
        }
    }
    void lend(Scene<R>& s, Desk<R>& d, Way way) const {
        for (const Instruction& i : code)
            if (i.field >= 0)
                d.value[i.field] = s.value[i.field], d.bar[i.field] = s.bar[i.field], d.dot[i.field] = s.dot[i.field];
        d.used.clear();
        each_sum(s, d, way, [&](const Instruction& i, R* to, R*& at, auto& share, size_t pitch) {
            if (at == share.memory.data && at != nullptr) return;  // by another instruction
            const size_t size = program.fields[i.field].padded * pitch;
            if (share.memory.size < size) share.memory.reset(size);
            at = share.memory.data, share.to = to, share.low = size, share.high = 0;
            d.used.push_back(&share);
        });
        if (d.picked.size() < tables.size() * L) d.picked.resize(tables.size() * L);
    }
    void clear(Scene<R>& s, Desk<R>& d, const Span& all, Way way, int first, int last) const {
        each_sum(s, d, way, [&](const Instruction& i, R*, R*&, auto& share, size_t pitch) {
            const auto [low, high] = rows_of(i, all, first, last);
            share.low = std::min(share.low, low * pitch), share.high = std::max(share.high, (high + 1) * pitch);
        });
        for (auto* share : d.used) std::fill(share->memory.data + share->low, share->memory.data + share->high, R(0));
    }
    // What the others' shares hold: every thread sees to the rows that it has near.
    static void add_up(Scene<R>& s, int parts) {
        bool any = false;
        for (int m = 1; m < parts; m++) any = any || !s.desks[m - 1].used.empty();
        if (any) s.team->run(parts, [&](int part) { add_part(s, parts, part); });
    }
    static void add_part(Scene<R>& s, int parts, int part) {
        for (int m = 1; m < parts; m++)
            for (auto* share : s.desks[m - 1].used) {
                const size_t lines = (share->memory.size + LANES<R> - 1) / LANES<R>;
                const size_t low = std::max(share->low, lines * part / parts * LANES<R>);
                const size_t high = std::min(share->high, lines * (part + 1) / parts * LANES<R>);
                for (size_t k = low; k < high; k++) share->to[k] += share->memory.data[k];
            }
    }
    // The first and the last row.
    std::pair<size_t, size_t> rows_of(const Instruction& i, const Span& all, int first, int last) const {
        if (i.table == SHARED) return {0, 0};
        int low = row(i, first, all), high = low;
        if (all.list)
            for (int k = first; k < last; k++) low = std::min(low, row(i, k, all)), high = std::max(high, row(i, k, all));
        else {
            const int* at = index(i, all);
            for (int k = first; k < last; k++) low = std::min(low, at[k]), high = std::max(high, at[k]);
        }
        return {size_t(low), size_t(high)};
    }
};

}  // namespace tc
