// The lanes of a pack are scenes of one batch, and every item has packs of its own. Numbers of the scenes lie next to
// each other in memory, so that a loop copies whole packs where it would gather the items of a single scene.
#pragma once

#include "gather_scatter.h"

namespace tc {

constexpr int ITEMS_IN_LANES = 4;  // go through an instruction together, each with registers of its own

// Reads and writes as GatherScatter does, for the same instructions; tangents have their directions in the lanes.
template <class R>
struct SceneLanes {
    static constexpr int L = LANES<R>;
    static constexpr int ITEMS = ITEMS_IN_LANES;
    using P = Wide<R>;

    const GatherScatter<R>& loop;

    ItemSpan span(Scene<R>& s) const {
        ItemSpan all = loop.span(s);
        if (!loop.nearby.empty()) all.list = loop.nearby.data();
        return all;
    }
    void prepare_rows(const ItemSpan&, int*, int) const {}
    void gather_invariants(Scene<R>&, const ItemSpan&) const {}

    // Calls f(first of its registers) for every item from `first` on.
    template <class F>
    TC_INLINE void for_each_item(int first, const ItemSpan& s, F f) const {
        const int count = std::min(ITEMS, s.items - first);
        for (int k = 0; k < count; k++) f(size_t(k) * loop.program.registers);
    }
    // Calls f(first register) for every set of registers: numbers that items share stand in all of them.
    template <class F>
    TC_INLINE void for_each_register_set(F f) const {
        for (int k = 0; k < ITEMS; k++) f(size_t(k) * loop.program.registers);
    }
    // Calls f(number of the element where its row begins, first of its registers) for every item from `first` on.
    template <class F>
    TC_INLINE void rows(const Instruction& i, int first, const ItemSpan& s, F f) const {
        const size_t pitch = loop.pitch(i), registers = loop.program.registers;
        const int count = std::min(ITEMS, s.items - first), *index = i.table >= 0 ? loop.index(i, s) : nullptr;
        for (int k = 0; k < count; k++) {
            const int item = s.at(first + k);
            f(i.table == SINGLE_ROW ? 0 : size_t(index ? index[item] : item) * pitch, k * registers);
        }
    }

    TC_INLINE void load(const Scene<R>&, const Instruction& i, const R* from, P* to, int first,
                        const ItemSpan& s) const {
        if (i.is_constant)
            rows(i, first, s, [&](size_t at, size_t reg) { broadcast(i, from + at, to + reg); });
        else
            loop.components(i, [&](auto comps) {
                rows(i, first, s, [&](size_t at, size_t reg) {
                    for (int c = 0; c < comps; c++) to[reg + i.reg + c] = packs(from)[at + c];
                });
            });
    }
    void gather_shared(const Instruction& i, const R* from, P* to, const ItemSpan&) const {
        for_each_register_set([&](size_t reg) {
            if (i.is_constant) broadcast(i, from, to + reg);
            else loop.copy(to + reg + i.reg, packs(from), i.comps);
        });
    }
    TC_INLINE void add(const Instruction& i, R* to, const P* from, int first, const ItemSpan& s) const {
        loop.components(i, [&](auto comps) {
            rows(i, first, s, [&](size_t at, size_t reg) {
                P* row = packs(to) + at;
                for (int c = 0; c < comps; c++) row[c] = row[c] + from[reg + i.reg + c];
            });
        });
    }
    void add_shared(const Instruction& i, R* to, const P* from) const {
        for_each_register_set([&](size_t reg) {
            for (int c = 0; c < i.comps; c++) packs(to)[c] = packs(to)[c] + from[reg + i.reg + c];
        });
    }
    TC_INLINE void store(const Instruction& i, R* to, const P* from, int first, const ItemSpan& s) const {
        loop.components(i, [&](auto comps) {
            rows(i, first, s, [&](size_t at, size_t reg) {
                for (int c = 0; c < comps; c++) packs(to)[at + c] = from[reg + i.reg + c];
            });
        });
    }
    TC_INLINE void scatter_adjoint(const Instruction& i, R* from, P* bars, int first, const ItemSpan& s) const {
        loop.components(i, [&](auto comps) {
            rows(i, first, s, [&](size_t at, size_t reg) {
                P *row = packs(from) + at, *to = bars + reg + i.reg;
                for (int c = 0; c < comps; c++) {
                    to[c] = to[c] + row[c];
                    if (i.code == Opcode::store) row[c] = P(0.0);
                }
            });
        });
    }

  private:
    static P* packs(R* field) { return reinterpret_cast<P*>(field); }
    static const P* packs(const R* field) { return reinterpret_cast<const P*>(field); }
    static TC_INLINE void broadcast(const Instruction& i, const R* from, P* to) {
        for (int c = 0; c < i.comps; c++) to[i.reg + c] = P(from[c]);
    }
};

}  // namespace tc
