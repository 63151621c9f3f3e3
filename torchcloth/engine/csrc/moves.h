// How loops read and write: numbers are gathered from rows into registers, a pack of items at a time, and scattered to rows.
#pragma once

#include <algorithm>
#include <type_traits>

#include "program.h"
#include "transfer_along.h"

namespace tc {

constexpr int OWN = -1;     // item i reads and writes row i
constexpr int SHARED = -2;  // all items read, or add to, row 0
constexpr int VARYING = -3; // and below: rows that contact finds at every substep
constexpr int CELL = 11;    // registers that a lookup gives

// lookup: three registers, a place on a grid in cells, give the fractions of its cell and the values at its corners.
// spread and collect: between registers and the nodes of the grid, `in` = (first offset, first share, By).
struct Instruction {
    enum Code { load, call, add, put, lookup, spread, collect } code;
    int field, table, reg, comps;
    int kernel;
    std::vector<int> in, out;  // of a lookup: {first register, nodes along x, y, z} and {first register}
    bool feeds = false;        // another call reads what this one gives
    int slot = 0;              // of its table among those of the loop
    bool packed = false;       // the field's kind is points
    int fixed = -1;            // number of what Scene::fixed has for this load; -1: it varies
};

// The items of one run: all, those of a list, or as many as contact counts.
struct Span {
    const int* list;
    int items;
    const int* picked;          // rows of a list's items in this pack, by slot; each thread has its own
    const int* const* varying;  // rows that contact has found
    int at(int k) const { return list ? list[k] : k; }
};

template <class R>
struct Moves {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;

    const Program<R>& program;
    int items, list;  // list: of a sieve; -1: all items
    int counted;      // which of the scene's counts says how many items there are; -1: none does
    std::vector<Instruction> code;
    std::vector<int> tables;  // that it uses

    int slot(int table) {
        const auto found = std::find(tables.begin(), tables.end(), table);
        if (found != tables.end()) return int(found - tables.begin());
        tables.push_back(table);
        return int(tables.size()) - 1;
    }
    Span span(Scene<R>& s) const {
        if (list < 0) return {nullptr, counted < 0 ? items : s.counts[counted], nullptr, s.rows.data()};
        if (s.picked.size() < tables.size() * L) s.picked.resize(tables.size() * L);
        return {s.lists[list].items.data(), s.lists[list].count, s.picked.data(), nullptr};
    }
    // Look up once what all instructions on this pack need.
    void pick(const Span& s, int* picked, int first) const {
        if (list < 0) return;
        const int* item = s.list + first;
        for (size_t k = 0; k < tables.size(); k++) {
            int* to = picked + k * L;
            if (tables[k] == OWN) std::copy(item, item + L, to);
            else if (tables[k] >= 0) {
                const int* index = program.tables[tables[k]].data();
                for (int lane = 0; lane < L; lane++) to[lane] = index[item[lane]];
            }
        }
    }
    // Row of an item; items beyond the last count as the last.
    int row(const Instruction& i, int item, const Span& s) const {
        if (i.table == SHARED) return 0;
        const int k = s.at(item < s.items ? item : s.items - 1);
        return i.table == OWN ? k : index(i, s)[k];
    }
    const int* index(const Instruction& i, const Span& s) const {
        return i.table <= VARYING ? s.varying[VARYING - i.table] : program.tables[i.table].data();
    }
    size_t pitch(const Instruction& i) const { return program.fields[i.field].pitch; }
    int count(int first, const Span& s) const { return std::min(L, s.items - first); }

    // f(where each lane's row starts, numbers between rows), the frequent cases with constants that the compiler sees.
    template <class F>
    TC_INLINE void rows(const Instruction& i, int first, const Span& s, F f) const {
        const size_t step = pitch(i);
        const bool whole = count(first, s) == L;
        if (i.table == OWN && whole && s.list == nullptr && step <= 4) {
            if (step == 4) f([first](int lane) { return size_t(first + lane) * 4; }, four);
            else f([first](int lane) { return size_t(first + lane); }, one);
            return;
        }
        int each[L];
        const int* at = each;
        if (s.list && i.table != SHARED) at = s.picked + i.slot * L;
        else if (whole && (i.table >= 0 || i.table <= VARYING)) at = index(i, s) + first;
        else for (int lane = 0; lane < L; lane++) each[lane] = row(i, first + lane, s);
        if (step == 4) f([at](int lane) { return size_t(at[lane]) * 4; }, four);
        else if (step == 1) f([at](int lane) { return size_t(at[lane]); }, one);
        else f([at, step](int lane) { return size_t(at[lane]) * step; }, step);
    }
    static constexpr std::integral_constant<size_t, 1> one{};
    static constexpr std::integral_constant<size_t, 4> four{};
    // f(components), with the frequent number as a constant.
    template <class F>
    static TC_INLINE void components(const Instruction& i, F f) {
        if (i.comps == 3) f(std::integral_constant<int, 3>{});
        else f(i.comps);
    }

    // Where the numbers of a pack begin, in a field of points: [packs, comps, L].
    static size_t packed(const Instruction& i, int first) { return size_t(first) * i.comps; }

    // What never changes during a run, in the order of this loop: gathered once, or when contact lists other points.
    bool is_fixed(int field, int table) const {
        const Field& f = program.fields[field];
        const bool given = f.kind == Kind::constant || f.kind == Kind::parameter;
        return given && list < 0 && table > VARYING - WOKEN_LIST && table != SHARED && (table != OWN || f.comps > 1);
    }
    void fix(Scene<R>& s, const Span& all) const {
        P* regs = s.regs.data;
        for (const Instruction& i : code) {
            if (i.fixed < 0) continue;
            Fixed<R>& to = s.fixed[i.fixed];
            const int wanted = i.table <= VARYING ? s.lists_made : 0;
            if (to.made == wanted) continue;
            to.made = wanted;
            to.packs.reset(size_t(round_up(all.items, L)) * i.comps);
            for (int first = 0; first < all.items; first += L) {
                gather(i, s.value[i.field], regs, first, all);
                copy(reinterpret_cast<P*>(to.packs.data + packed(i, first)), regs + i.reg, i.comps);
            }
        }
    }
    // The frequent numbers as constants: no call.
    static TC_INLINE void copy(P* to, const P* from, int count) {
        auto some = [&](auto n) { std::memcpy(static_cast<void*>(to), from, n * sizeof(P)); };
        if (count == 3) some(std::integral_constant<size_t, 3>{});
        else if (count == 1) some(std::integral_constant<size_t, 1>{});
        else if (count == 4) some(std::integral_constant<size_t, 4>{});
        else if (count == 16) some(std::integral_constant<size_t, 16>{});
        else some(size_t(count));
    }

    TC_APART void gather(const Instruction& i, const R* from, P* to, int first, const Span& s) const {
        rows(i, first, s, [&](auto place, auto step) {
            if (step == 1)
                for (int lane = 0; lane < L; lane++) to[i.reg].v[lane] = from[place(lane)];
            else components(i, [&](auto comps) {
                for (int c = 0; c < comps; c += 4) {
                    P quad[4];
                    gather_quads([&](int lane) { return from + place(lane) + c; }, quad);
                    for (int k = 0; k < 4 && c + k < comps; k++) to[i.reg + c + k] = quad[k];
                }
            });
        });
    }
    // change(where a number or four lie, what came from the lane) for all lanes that are items.
    template <class F>
    TC_INLINE void scatter(const Instruction& i, R* to, const P* from, int first, const Span& s, F change) const {
        const int lanes = count(first, s);
        rows(i, first, s, [&](auto place, auto step) {
            if (step == 1)
                for (int lane = 0; lane < lanes; lane++) change(to[place(lane)], from[i.reg].v[lane]);
            else components(i, [&](auto comps) {
                for (int c = 0; c < comps; c += 4) {
                    P quad[4];
                    for (int k = 0; k < 4; k++) quad[k] = c + k < comps ? from[i.reg + c + k] : P(0.0);
                    auto give = [&](int lane, Quad<R> numbers) { change(*reinterpret_cast<Quad<R>*>(to + place(lane) + c), numbers); };
                    if (lanes == L) scatter_quads(quad, give);
                    else scatter_quads(quad, [&](int lane, Quad<R> numbers) { if (lane < lanes) give(lane, numbers); });
                }
            });
        });
    }
    TC_APART void add(const Instruction& i, R* to, const P* from, int first, const Span& s) const {
        if (i.packed)
            for (int c = 0; c < i.comps; c++) {
                P& there = reinterpret_cast<P*>(to + packed(i, first))[c];
                there = there + from[i.reg + c];
            }
        else if (i.table == SHARED && count(first, s) == L)
            for (int c = 0; c < i.comps; c++) to[c] += total(from[i.reg + c]);
        else scatter(i, to, from, first, s, [](auto& place, auto x) { place = place + x; });
    }
    TC_APART void store(const Instruction& i, R* to, const P* from, int first, const Span& s) const {
        scatter(i, to, from, first, s, [](auto& place, auto x) { place = x; });
    }
    TC_APART void look(const Instruction& i, const R* table, P* regs) const {
        const int *in = i.in.data(), out = i.out[0];
        for (int lane = 0; lane < L; lane++) {
            int cell[3];
            for (int k = 0; k < 3; k++) {
                const R place = regs[in[0] + k].v[lane];
                cell[k] = place > 0 ? int(std::min(place, R(in[k + 1] - 2))) : 0;  // also where it is not finite
                regs[out + k].v[lane] = place - cell[k];
            }
            const R* at = table + (size_t(cell[0]) * in[2] + cell[1]) * in[3] + cell[2];
            for (int corner = 0; corner < 8; corner++)
                regs[out + 3 + corner].v[lane] = at[(size_t(corner >> 2) * in[2] + (corner >> 1 & 1)) * in[3] + (corner & 1)];
        }
    }

    // Adjoint of a result; what was overwritten before does not count any more.
    TC_APART void take(const Instruction& i, R* from, P* bars, int first, const Span& s) const {
        if (i.packed) {
            for (int c = 0; c < i.comps; c++) bars[i.reg + c] = bars[i.reg + c] + reinterpret_cast<P*>(from + packed(i, first))[c];
            return;
        }
        const int lanes = count(first, s);
        const bool spent = i.code == Instruction::put;
        rows(i, first, s, [&](auto place, auto step) {
            for (int c = 0; c < i.comps; c += 4) {
                P seeds[4];
                if (step == 1)
                    for (int lane = 0; lane < L; lane++) seeds[0].v[lane] = from[place(lane)];
                else gather_quads([&](int lane) { return from + place(lane) + c; }, seeds);
                for (int k = 0; k < 4 && c + k < i.comps; k++) {
                    for (int lane = lanes; lane < L; lane++) seeds[k].v[lane] = 0;
                    bars[i.reg + c + k] = bars[i.reg + c + k] + seeds[k];
                }
            }
            for (int lane = 0; spent && lane < lanes; lane++)
                for (int c = 0; c < i.comps; c++) from[place(lane) + c] = 0;
        });
    }

    template <class D>
    TC_APART void gather_along(const Instruction& i, const R* from, D* dots, int first, const Span& s) const {
        if (from == nullptr) return;
        const D* source = reinterpret_cast<const D*>(from);
        D* to = dots + size_t(i.reg) * L;
        if (i.packed) return void(std::memcpy(static_cast<void*>(to), source + packed(i, first), i.comps * L * sizeof(D)));
        rows(i, first, s, [&](auto place, auto) {
            components(i, [&](auto comps) {
                for (int lane = 0; lane < L; lane++) {
                    const D* at = source + place(lane);
                    for (int c = 0; c < comps; c++) to[c * L + lane] = at[c];
                }
            });
        });
    }
    template <class D>
    TC_APART void scatter_along(const Instruction& i, R* to, const D* dots, int first, bool adds, const Span& s) const {
        D* target = reinterpret_cast<D*>(to);
        const D* from = dots + size_t(i.reg) * L;
        if (i.packed) return void(std::memcpy(static_cast<void*>(target + packed(i, first)), from, i.comps * L * sizeof(D)));
        const int lanes = count(first, s);
        rows(i, first, s, [&](auto place, auto) {
            components(i, [&](auto comps) {
                if (adds)
                    for (int lane = 0; lane < lanes; lane++)
                        for (int c = 0; c < comps; c++) target[place(lane) + c] = target[place(lane) + c] + from[c * L + lane];
                else
                    for (int lane = 0; lane < lanes; lane++)
                        for (int c = 0; c < comps; c++) target[place(lane) + c] = from[c * L + lane];
            });
        });
    }
};

}  // namespace tc
