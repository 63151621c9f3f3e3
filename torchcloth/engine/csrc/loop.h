// A loop over triangles, vertices or points: numbers are gathered into registers, kernels run on whole packs of items,
// and results are scattered. The reverse sweep and the tangents go through the same instructions.
#pragma once

#include "program.h"

namespace tc {

constexpr int OWN = -1;     // item i reads and writes row i
constexpr int SHARED = -2;  // all items read, or add to, row 0

struct Instruction {
    enum Code { load, call, add, put } code;
    int field, table, reg, comps;
    int kernel;
    std::vector<int> in, out;
    bool feeds = false;  // another call reads what this one gives
};

template <class R>
struct Loop : Stage<R> {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using D = Along<R>;

    const Program<R>& program;
    const Kernel<R>* kernels;
    int items;
    std::vector<Instruction> code;

    Loop(const Program<R>& p, const Kernel<R>* k, int n) : program(p), kernels(k), items(n) {}

    // Row of an item; items beyond the last count as the last.
    int row(const Instruction& i, int item) const {
        if (i.table == SHARED) return 0;
        const int k = item < items ? item : items - 1;
        return i.table == OWN ? k : program.tables[i.table][k];
    }
    size_t stride(const Instruction& i) const { return program.fields[i.field].padded; }

    void gather(const Instruction& i, const R* from, P* to, int first) const {
        const size_t step = stride(i);
        const bool whole = first + L <= items;
        for (int c = 0; c < i.comps; c++) {
            const R* source = from + c * step;
            P& target = to[i.reg + c];
            if (i.table == OWN && whole) target = *reinterpret_cast<const P*>(source + first);
            else if (i.table >= 0 && whole) {
                const int* index = program.tables[i.table].data() + first;
                for (int lane = 0; lane < L; lane++) target.v[lane] = source[index[lane]];
            } else for (int lane = 0; lane < L; lane++) target.v[lane] = source[row(i, first + lane)];
        }
    }
    void scatter(const Instruction& i, R* to, const P* from, int first) const {
        const size_t step = stride(i);
        const int count = first + L <= items ? L : items - first;
        for (int c = 0; c < i.comps; c++) {
            R* target = to + c * step;
            const P& source = from[i.reg + c];
            if (i.table == OWN && count == L) *reinterpret_cast<P*>(target + first) = *reinterpret_cast<P*>(target + first) + source;
            else if (i.table >= 0) {
                const int* index = program.tables[i.table].data() + first;
                for (int lane = 0; lane < count; lane++) target[index[lane]] += source.v[lane];
            } else for (int lane = 0; lane < count; lane++) target[row(i, first + lane)] += source.v[lane];
        }
    }
    void store(const Instruction& i, R* to, const P* from, int first) const {
        const size_t step = stride(i);
        const int count = first + L <= items ? L : items - first;
        for (int c = 0; c < i.comps; c++)
            for (int lane = 0; lane < count; lane++) to[c * step + row(i, first + lane)] = from[i.reg + c].v[lane];
    }
    bool is_shared(const Instruction& i) const { return i.code == Instruction::load && i.table == SHARED; }

    void forward(Scene<R>& s) const override {
        P* regs = s.regs.data;
        for (const Instruction& i : code) if (is_shared(i)) gather(i, s.value[i.field], regs, 0);
        for (int first = 0; first < items; first += L)
            for (const Instruction& i : code) switch (i.code) {
                case Instruction::load: if (!is_shared(i)) gather(i, s.value[i.field], regs, first); break;
                case Instruction::call: kernels[i.kernel].value(regs, i.in.data(), i.out.data()); break;
                case Instruction::add: scatter(i, s.value[i.field], regs, first); break;
                case Instruction::put: store(i, s.value[i.field], regs, first); break;
            }
    }

    void reverse(Scene<R>& s) const override {
        P *regs = s.regs.data, *bars = s.bars.data;
        s.bars.clear();
        for (const Instruction& i : code) if (is_shared(i)) gather(i, s.value[i.field], regs, 0);
        for (int first = 0; first < items; first += L) {
            for (const Instruction& i : code) {
                if (i.code == Instruction::load && !is_shared(i)) {
                    gather(i, s.value[i.field], regs, first);
                    for (int c = 0; c < i.comps; c++) bars[i.reg + c] = P(0.0);
                } else if (i.code == Instruction::call) {
                    if (i.feeds) kernels[i.kernel].value(regs, i.in.data(), i.out.data());
                    for (int o : i.out) if (o >= 0) bars[o] = P(0.0);
                }
            }
            for (auto i = code.rbegin(); i != code.rend(); ++i) switch (i->code) {
                case Instruction::add:
                case Instruction::put: take(*i, s.bar[i->field], bars, first); break;
                case Instruction::call: kernels[i->kernel].adjoint(regs, bars, i->in.data(), i->out.data()); break;
                case Instruction::load: if (!is_shared(*i) && s.bar[i->field]) scatter(*i, s.bar[i->field], bars, first); break;
            }
        }
        for (const Instruction& i : code)
            if (is_shared(i) && s.bar[i.field])
                for (int c = 0; c < i.comps; c++) s.bar[i.field][c * stride(i)] += total(bars[i.reg + c]);
    }
    // Adjoint of a result; what was overwritten before does not count any more.
    void take(const Instruction& i, R* from, P* bars, int first) const {
        const size_t step = stride(i);
        const int count = first + L <= items ? L : items - first;
        for (int c = 0; c < i.comps; c++) {
            P seed(0.0);
            for (int lane = 0; lane < count; lane++) {
                R& place = from[c * step + row(i, first + lane)];
                seed.v[lane] = place;
                if (i.code == Instruction::put) place = 0;
            }
            bars[i.reg + c] = bars[i.reg + c] + seed;
        }
    }

    void tangent(Scene<R>& s) const override {
        P* regs = s.regs.data;
        D* dots = s.dots.data;
        s.dots.clear();  // what has no tangent
        for (const Instruction& i : code)
            if (is_shared(i)) {
                gather(i, s.value[i.field], regs, 0);
                gather_along(i, s.dot[i.field], dots, 0);
            }
        for (int first = 0; first < items; first += L)
            for (const Instruction& i : code) switch (i.code) {
                case Instruction::load:
                    if (is_shared(i)) break;
                    gather(i, s.value[i.field], regs, first);
                    gather_along(i, s.dot[i.field], dots, first);
                    break;
                case Instruction::call: kernels[i.kernel].tangent(regs, dots, i.in.data(), i.out.data()); break;
                case Instruction::add:
                    scatter(i, s.value[i.field], regs, first);
                    scatter_along(i, s.dot[i.field], dots, first, true);
                    break;
                case Instruction::put:
                    store(i, s.value[i.field], regs, first);
                    scatter_along(i, s.dot[i.field], dots, first, false);
                    break;
            }
    }
    void gather_along(const Instruction& i, const R* from, D* dots, int first) const {
        if (from == nullptr) return;
        const D* source = reinterpret_cast<const D*>(from);
        const size_t step = stride(i);
        for (int lane = 0; lane < L; lane++) {
            const int k = row(i, first + lane);
            for (int c = 0; c < i.comps; c++) dots[(i.reg + c) * L + lane] = source[c * step + k];
        }
    }
    void scatter_along(const Instruction& i, R* to, const D* dots, int first, bool adds) const {
        D* target = reinterpret_cast<D*>(to);
        const size_t step = stride(i);
        const int count = first + L <= items ? L : items - first;
        for (int lane = 0; lane < count; lane++) {
            const int k = row(i, first + lane);
            for (int c = 0; c < i.comps; c++) {
                const D& x = dots[(i.reg + c) * L + lane];
                D& place = target[c * step + k];
                place = adds ? place + x : x;
            }
        }
    }
};

}  // namespace tc
