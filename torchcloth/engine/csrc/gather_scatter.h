// How loops read and write: numbers are gathered from rows into registers, a pack of items at a time, and scattered to
// rows.
#pragma once

#include <algorithm>
#include <numeric>
#include <type_traits>

#include "program.h"
#include "transfer_jvp.h"

namespace tc {

constexpr int LOOKUP_REGISTERS = 11;  // three fractions of a cell, and the values at its eight corners

// A lookup takes three registers with a place in a grid, in cells, and gives the fractions of its cell and the values
// at its corners. p2g and g2p work between registers and the nodes of the grid, with `in` = (first register of the
// offset, first register of the shares, TransferBasis).
struct Instruction {
    Opcode code;
    int field, table, reg, comps;
    int kernel;
    std::vector<int> in, out;     // of a lookup: {first register, nodes along x, y, z} and {first register}
    bool is_needed = false;       // the reverse sweep reads its results
    int table_slot = 0;           // of its table among those of the loop
    bool is_point_field = false;  // the field's kind is points
    bool is_constant = false;     // the field's kind is constant
    int invariant = -1;           // number of the load in Scene::invariants; -1: it varies
};

// The items of one run: all, those of a list, or as many as the contact search counts.
struct ItemSpan {
    const int* list;
    int items;
    const int* picked;               // rows of a list's items in this pack, by slot; each thread has its own
    const int* const* contact_rows;  // tables that the contact search lists
    int at(int k) const { return list ? list[k] : k; }
};

// The lanes of a pack are items of one scene.
template <class R>
struct GatherScatter {
    static constexpr int L = LANES<R>;
    static constexpr int ITEMS = L;  // of a pack
    using P = Wide<R>;

    const Program<R>& program;
    int items, point_list;  // point_list: of a broad phase; -1: all items
    int contact_points;     // which contact points are the items, a contact_count; -1: none
    std::vector<Instruction> code;
    std::vector<int> tables;  // that the loop uses
    std::vector<int> nearby;  // all items, those of nearby rows one after the other

    // Orders items for loops that take one at a time: what they read was read shortly before. Packs of items want the
    // contrary, rows that are all different.
    void order_nearby() {
        const auto of_rows = std::find_if(tables.begin(), tables.end(), [](int table) { return table >= 0; });
        if (of_rows == tables.end() || point_list >= 0 || contact_points >= 0) return;
        const std::vector<int>& row = program.tables[*of_rows];
        nearby.resize(items);
        std::iota(nearby.begin(), nearby.end(), 0);
        std::stable_sort(nearby.begin(), nearby.end(), [&](int a, int b) { return row[a] < row[b]; });
    }

    int slot_of(int table) {
        const auto at = std::find(tables.begin(), tables.end(), table);
        if (at != tables.end()) return int(at - tables.begin());
        tables.push_back(table);
        return int(tables.size()) - 1;
    }
    ItemSpan span(Scene<R>& s) const {
        if (point_list < 0)
            return {nullptr, contact_points < 0 ? items : s.contact_counts[contact_points], nullptr,
                    s.contact_rows.data()};
        if (s.picked.size() < tables.size() * L) s.picked.resize(tables.size() * L);
        return {s.point_lists[point_list].items.data(), s.point_lists[point_list].count, s.picked.data(), nullptr};
    }
    // Looks up the rows that all instructions on this pack need.
    void prepare_rows(const ItemSpan& s, int* picked, int first) const {
        if (point_list < 0) return;
        const int* item = s.list + first;
        for (size_t k = 0; k < tables.size(); k++) {
            int* to = picked + k * L;
            if (tables[k] == ITEM_ROW) std::copy(item, item + L, to);
            else if (tables[k] >= 0) {
                const int* index = program.tables[tables[k]].data();
                for (int lane = 0; lane < L; lane++) to[lane] = index[item[lane]];
            }
        }
    }
    // Row of an item; items beyond the last have the last one's row.
    int row(const Instruction& i, int item, const ItemSpan& s) const {
        if (i.table == SINGLE_ROW) return 0;
        const int k = s.at(item < s.items ? item : s.items - 1);
        return i.table == ITEM_ROW ? k : index(i, s)[k];
    }
    const int* index(const Instruction& i, const ItemSpan& s) const {
        return i.table <= CONTACT_ROWS ? s.contact_rows[CONTACT_ROWS - i.table] : program.tables[i.table].data();
    }
    size_t pitch(const Instruction& i) const { return program.fields[i.field].pitch; }
    int count(int first, const ItemSpan& s) const { return std::min(L, s.items - first); }

    // Calls f(where each lane's row begins, numbers between rows), in frequent cases with constants for the compiler.
    template <class F>
    TC_INLINE void rows(const Instruction& i, int first, const ItemSpan& s, F f) const {
        const size_t step = pitch(i);
        const bool whole = count(first, s) == L;
        if (i.table == ITEM_ROW && whole && s.list == nullptr && step <= 4) {
            if (step == 4) f([first](int lane) { return size_t(first + lane) * 4; }, four);
            else f([first](int lane) { return size_t(first + lane); }, one);
            return;
        }
        int each[L];
        const int* at = each;
        if (s.list && i.table != SINGLE_ROW) at = s.picked + i.table_slot * L;
        else if (whole && (i.table >= 0 || i.table <= CONTACT_ROWS)) at = index(i, s) + first;
        else for (int lane = 0; lane < L; lane++) each[lane] = row(i, first + lane, s);
        if (step == 4) f([at](int lane) { return size_t(at[lane]) * 4; }, four);
        else if (step == 1) f([at](int lane) { return size_t(at[lane]); }, one);
        else f([at, step](int lane) { return size_t(at[lane]) * step; }, step);
    }
    static constexpr std::integral_constant<size_t, 1> one{};
    static constexpr std::integral_constant<size_t, 4> four{};
    // Calls f(components), with the frequent number as a constant.
    template <class F>
    static TC_INLINE void components(const Instruction& i, F f) {
        if (i.comps == 3) f(std::integral_constant<int, 3>{});
        else f(i.comps);
    }

    // Where the numbers of a pack begin in a field of points, which is [packs, comps, L].
    static size_t packed_place(const Instruction& i, int first) { return size_t(first) * i.comps; }

    // Whether rows never change during a run, so that they are gathered once, or when contact lists other points.
    bool is_invariant(int field, int table) const {
        const Field& f = program.fields[field];
        const bool is_input = f.kind == FieldKind::constant || f.kind == FieldKind::parameter;
        const bool is_listed_once = point_list < 0 && table > CONTACT_ROWS - contact_table::activated;
        return is_input && is_listed_once && table != SINGLE_ROW && (table != ITEM_ROW || f.comps > 1);
    }
    void gather_invariants(Scene<R>& s, const ItemSpan& all) const {
        P* regs = s.regs.data;
        for (const Instruction& i : code) {
            if (i.invariant < 0) continue;
            LoopInvariant<R>& to = s.invariants[i.invariant];
            const int wanted = i.table <= CONTACT_ROWS ? s.contact_version : 0;
            if (to.version == wanted) continue;
            to.version = wanted;
            to.packs.reset(size_t(round_up(all.items, L)) * i.comps);
            for (int first = 0; first < all.items; first += L) {
                gather(i, s.value[i.field], regs, first, all);
                copy(reinterpret_cast<P*>(to.packs.data + packed_place(i, first)), regs + i.reg, i.comps);
            }
        }
    }
    // Copies packs; frequent counts are constants, which need no call.
    static TC_INLINE void copy(P* to, const P* from, int count) {
        auto copy_packs = [&](auto n) { std::memcpy(static_cast<void*>(to), from, n * sizeof(P)); };
        if (count == 3) copy_packs(std::integral_constant<size_t, 3>{});
        else if (count == 1) copy_packs(std::integral_constant<size_t, 1>{});
        else if (count == 4) copy_packs(std::integral_constant<size_t, 4>{});
        else if (count == 16) copy_packs(std::integral_constant<size_t, 16>{});
        else copy_packs(size_t(count));
    }

    TC_INLINE void load(const Scene<R>& scene, const Instruction& i, const R* from, P* to, int first,
                        const ItemSpan& s) const {
        if (i.invariant >= 0) from = scene.invariants[i.invariant].packs.data;
        if (i.invariant >= 0 || i.is_point_field)
            copy(to + i.reg, reinterpret_cast<const P*>(from + packed_place(i, first)), i.comps);
        else gather(i, from, to, first, s);
    }
    TC_APART void gather(const Instruction& i, const R* from, P* to, int first, const ItemSpan& s) const {
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
    // Calls change(a number or four numbers in memory, those of the lane) for all lanes that are items.
    template <class F>
    TC_INLINE void scatter(const Instruction& i, R* to, const P* from, int first, const ItemSpan& s, F change) const {
        const int lanes = count(first, s);
        rows(i, first, s, [&](auto place, auto step) {
            if (step == 1)
                for (int lane = 0; lane < lanes; lane++) change(to[place(lane)], from[i.reg].v[lane]);
            else components(i, [&](auto comps) {
                for (int c = 0; c < comps; c += 4) {
                    P quad[4];
                    for (int k = 0; k < 4; k++) quad[k] = c + k < comps ? from[i.reg + c + k] : P(0.0);
                    auto give = [&](int lane, Quad<R> numbers) {
                        change(*reinterpret_cast<Quad<R>*>(to + place(lane) + c), numbers);
                    };
                    if (lanes == L) scatter_quads(quad, give);
                    else scatter_quads(quad, [&](int lane, Quad<R> numbers) { if (lane < lanes) give(lane, numbers); });
                }
            });
        });
    }
    TC_APART void add(const Instruction& i, R* to, const P* from, int first, const ItemSpan& s) const {
        if (i.is_point_field)
            for (int c = 0; c < i.comps; c++) {
                P& element = reinterpret_cast<P*>(to + packed_place(i, first))[c];
                element = element + from[i.reg + c];
            }
        else if (i.table == SINGLE_ROW && count(first, s) == L) add_shared(i, to, from);
        else scatter(i, to, from, first, s, [](auto& place, auto x) { place = place + x; });
    }
    // A single row, which all items share.
    void gather_shared(const Instruction& i, const R* from, P* to, const ItemSpan& s) const {
        gather(i, from, to, 0, s);
    }
    static void add_shared(const Instruction& i, R* to, const P* from) {
        for (int c = 0; c < i.comps; c++) to[c] += total(from[i.reg + c]);
    }
    // Calls f(first register) for each pack that goes through an instruction: here it is one.
    template <class F>
    TC_INLINE void for_each_item(int, const ItemSpan&, F f) const { f(size_t(0)); }
    template <class F>
    TC_INLINE void for_each_register_set(F f) const { f(size_t(0)); }
    TC_APART void store(const Instruction& i, R* to, const P* from, int first, const ItemSpan& s) const {
        if (i.is_point_field) copy(reinterpret_cast<P*>(to + packed_place(i, first)), from + i.reg, i.comps);
        else scatter(i, to, from, first, s, [](auto& place, auto x) { place = x; });
    }
    TC_APART void grid_lookup(const Instruction& i, const R* table, P* regs) const {
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
                regs[out + 3 + corner].v[lane] =
                    at[(size_t(corner >> 2) * in[2] + (corner >> 1 & 1)) * in[3] + (corner & 1)];
        }
    }

    // Adds the adjoints of a result to registers; after a store, the adjoint of the overwritten value is 0.
    TC_APART void scatter_adjoint(const Instruction& i, R* from, P* bars, int first, const ItemSpan& s) const {
        if (i.is_point_field) {
            for (int c = 0; c < i.comps; c++)
                bars[i.reg + c] = bars[i.reg + c] + reinterpret_cast<P*>(from + packed_place(i, first))[c];
            return;
        }
        const int lanes = count(first, s);
        const bool clears = i.code == Opcode::store;
        rows(i, first, s, [&](auto place, auto step) {
            for (int c = 0; c < i.comps; c += 4) {
                P adjoints[4];
                if (step == 1)
                    for (int lane = 0; lane < L; lane++) adjoints[0].v[lane] = from[place(lane)];
                else gather_quads([&](int lane) { return from + place(lane) + c; }, adjoints);
                for (int k = 0; k < 4 && c + k < i.comps; k++) {
                    for (int lane = lanes; lane < L; lane++) adjoints[k].v[lane] = 0;
                    bars[i.reg + c + k] = bars[i.reg + c + k] + adjoints[k];
                }
            }
            for (int lane = 0; clears && lane < lanes; lane++)
                for (int c = 0; c < i.comps; c++) from[place(lane) + c] = 0;
        });
    }

    template <class D>
    TC_APART void gather_jvp(const Instruction& i, const R* from, D* dots, int first, const ItemSpan& s) const {
        if (from == nullptr) return;
        const D* source = reinterpret_cast<const D*>(from);
        D* to = dots + size_t(i.reg) * L;
        if (i.is_point_field)
            return void(std::memcpy(static_cast<void*>(to), source + packed_place(i, first), i.comps * L * sizeof(D)));
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
    TC_APART void scatter_jvp(const Instruction& i, R* to, const D* dots, int first, bool adds,
                              const ItemSpan& s) const {
        D* target = reinterpret_cast<D*>(to);
        const D* from = dots + size_t(i.reg) * L;
        if (i.is_point_field)
            return void(
                std::memcpy(static_cast<void*>(target + packed_place(i, first)), from, i.comps * L * sizeof(D)));
        const int lanes = count(first, s);
        rows(i, first, s, [&](auto place, auto) {
            components(i, [&](auto comps) {
                if (adds)
                    for (int lane = 0; lane < lanes; lane++)
                        for (int c = 0; c < comps; c++)
                            target[place(lane) + c] = target[place(lane) + c] + from[c * L + lane];
                else
                    for (int lane = 0; lane < lanes; lane++)
                        for (int c = 0; c < comps; c++) target[place(lane) + c] = from[c * L + lane];
            });
        });
    }
};

}  // namespace tc
