// A loop over triangles, vertices or points: numbers are gathered into registers, kernels run on whole packs of items,
// and results are scattered. The reverse sweep and the tangents go through the same instructions.
#pragma once

#include "moves.h"

namespace tc {

template <class R>
struct Loop : Stage<R>, Moves<R> {
    using typename Moves<R>::P;
    using typename Moves<R>::D;
    using Moves<R>::L, Moves<R>::program, Moves<R>::code, Moves<R>::index, Moves<R>::span, Moves<R>::count;
    using Moves<R>::pick, Moves<R>::fix, Moves<R>::copy, Moves<R>::packed, Moves<R>::look;
    using Moves<R>::gather, Moves<R>::add, Moves<R>::store, Moves<R>::take, Moves<R>::gather_along, Moves<R>::scatter_along;

    const Kernel<R>* kernels;
    bool flat;  // what it gives has no derivative

    Loop(const Program<R>& p, const Kernel<R>* k, int n, int list, int counted, bool flat)
        : Moves<R>{p, n, list, counted, {}, {}}, kernels(k), flat(flat) {}

    bool is_shared(const Instruction& i) const { return i.code == Instruction::load && i.table == SHARED; }

    // f(transfer) for the points of a pack.
    template <template <class, By> class Of, class F>
    TC_INLINE void transfer(const Instruction& i, int first, const Span& s, F f) const {
        const int *nodes = index(i, s) + size_t(first) * AROUND, lanes = count(first, s);
        if (By(i.in[2]) == By::slopes) f(Of<R, By::slopes>{nodes, lanes});
        else f(Of<R, By::arms>{nodes, lanes});
    }
    static void zero(P* registers, int first, int count) {
        for (int r = 0; r < count; r++) registers[first + r] = P(0.0);
    }

    void forward(Scene<R>& s) const override { values(s, false); }
    void replay(Scene<R>& s) const override { values(s, true); }
    void values(Scene<R>& s, bool again) const {
        P* regs = s.regs.data;
        const Span all = span(s);
        if (all.items == 0) return;
        fix(s, all);
        for (const Instruction& i : code) if (is_shared(i)) gather(i, s.value[i.field], regs, 0, all);
        for (int first = 0; first < all.items; first += L) {
            pick(s, first);
            for (const Instruction& i : code)
                if (!again || !is_recorded(i)) compute(s, i, first, all, regs);
        }
    }
    bool is_recorded(const Instruction& i) const {
        if (i.code != Instruction::add && i.code != Instruction::put) return false;
        const Kind kind = program.fields[i.field].kind;
        return kind != Kind::temporary && kind != Kind::nodes && kind != Kind::points;
    }
    TC_INLINE void compute(Scene<R>& s, const Instruction& i, int first, const Span& all, P* regs) const {
        R* field = i.field >= 0 ? s.value[i.field] : nullptr;
        switch (i.code) {
            case Instruction::load:
                if (i.fixed >= 0) field = s.fixed[i.fixed].packs.data;
                if (i.fixed >= 0 || i.packed) copy(regs + i.reg, reinterpret_cast<const P*>(field + packed(i, first)), i.comps);
                else if (!is_shared(i)) gather(i, field, regs, first, all);
                break;
            case Instruction::call: kernels[i.kernel].value(regs, i.in.data(), i.out.data()); break;
            case Instruction::add: add(i, field, regs, first, all); break;
            case Instruction::put:
                if (i.packed) copy(reinterpret_cast<P*>(field + packed(i, first)), regs + i.reg, i.comps);
                else store(i, field, regs, first, all);
                break;
            case Instruction::lookup: look(i, field, regs); break;
            case Instruction::spread:
                transfer<Transfer>(i, first, all, [&](auto t) { t.spread(regs + i.in[0], regs + i.in[1], field); });
                break;
            case Instruction::collect:
                transfer<Transfer>(i, first, all, [&](auto t) { t.collect(regs + i.in[0], regs + i.in[1], field); });
                break;
        }
    }

    void reverse(Scene<R>& s) const override {
        P *regs = s.regs.data, *bars = s.bars.data;
        const Span all = span(s);
        if (flat || all.items == 0) return;
        fix(s, all);
        for (const Instruction& i : code)
            if (is_shared(i)) {
                gather(i, s.value[i.field], regs, 0, all);
                zero(bars, i.reg, i.comps);
            }
        for (int first = 0; first < all.items; first += L) {
            pick(s, first);
            for (const Instruction& i : code) {
                const bool gives = i.code == Instruction::call || i.code == Instruction::collect;
                if (gives ? i.feeds : i.code == Instruction::load || i.code == Instruction::lookup) compute(s, i, first, all, regs);
                if (i.code == Instruction::load && !is_shared(i)) zero(bars, i.reg, i.comps);
                else if (i.code == Instruction::lookup) zero(bars, i.out[0], CELL);
                else if (i.code == Instruction::collect) zero(bars, i.in[1], SHARES);
                else if (i.code == Instruction::call) for (int o : i.out) if (o >= 0) bars[o] = P(0.0);
            }
            for (auto i = code.rbegin(); i != code.rend(); ++i) back(s, *i, first, all, regs, bars);
        }
        for (const Instruction& i : code)
            if (is_shared(i) && s.bar[i.field])
                for (int c = 0; c < i.comps; c++) s.bar[i.field][c] += total(bars[i.reg + c]);
    }
    TC_INLINE void back(Scene<R>& s, const Instruction& i, int first, const Span& all, P* regs, P* bars) const {
        R* bar = i.field >= 0 ? s.bar[i.field] : nullptr;
        switch (i.code) {
            case Instruction::add:
            case Instruction::put: take(i, bar, bars, first, all); break;
            case Instruction::call: kernels[i.kernel].adjoint(regs, bars, i.in.data(), i.out.data()); break;
            case Instruction::load: if (!is_shared(i) && bar) add(i, bar, bars, first, all); break;
            case Instruction::lookup:
                for (int k = 0; k < 3; k++) bars[i.in[0] + k] = bars[i.in[0] + k] + bars[i.out[0] + k];
                break;
            case Instruction::spread:
                transfer<Transfer>(i, first, all, [&](auto t) {
                    t.collect_and_weigh(regs + i.in[0], regs + i.in[1], bar, bars + i.in[1], bars + i.in[0]);
                });
                break;
            case Instruction::collect:
                transfer<Transfer>(i, first, all, [&](auto t) {
                    t.spread(regs + i.in[0], bars + i.in[1], bar);
                    t.weigh(regs + i.in[0], bars + i.in[1], s.value[i.field], bars + i.in[0]);
                });
                break;
        }
    }
    void tangent(Scene<R>& s) const override {
        if (flat) return forward(s);
        P* regs = s.regs.data;
        D* dots = s.dots.data;
        const Span all = span(s);
        if (all.items == 0) return;
        fix(s, all);
        for (const Instruction& i : code)  // what has no tangent
            if (i.code == Instruction::load && s.dot[i.field] == nullptr)
                std::memset(static_cast<void*>(dots + size_t(i.reg) * L), 0, size_t(i.comps) * L * sizeof(D));
        for (const Instruction& i : code)
            if (is_shared(i)) {
                gather(i, s.value[i.field], regs, 0, all);
                gather_along(i, s.dot[i.field], dots, 0, all);
            }
        for (int first = 0; first < all.items; first += L) {
            pick(s, first);
            for (const Instruction& i : code)
                if (i.code == Instruction::call) kernels[i.kernel].tangent(regs, dots, i.in.data(), i.out.data());
                else compute(s, i, first, all, regs), compute_along(s, i, first, all, regs, dots);
        }
    }
    TC_INLINE void compute_along(Scene<R>& s, const Instruction& i, int first, const Span& all, P* regs, D* dots) const {
        R* along = s.dot[i.field];
        const bool moves = i.code == Instruction::spread || i.code == Instruction::collect;
        D *offset = moves ? dots + i.in[0] * L : nullptr, *share = moves ? dots + i.in[1] * L : nullptr;
        switch (i.code) {
            case Instruction::load: if (!is_shared(i)) gather_along(i, along, dots, first, all); break;
            case Instruction::add: scatter_along(i, along, dots, first, true, all); break;
            case Instruction::put: scatter_along(i, along, dots, first, false, all); break;
            case Instruction::lookup:
                for (int k = 0; k < CELL * L; k++) dots[i.out[0] * L + k] = k < 3 * L ? dots[i.in[0] * L + k] : D(0.0);
                break;
            case Instruction::spread:
                transfer<TransferAlong>(i, first, all, [&](auto t) { t.spread(regs + i.in[0], offset, regs + i.in[1], share, along); });
                break;
            case Instruction::collect:
                transfer<TransferAlong>(i, first, all, [&](auto t) { t.collect(regs + i.in[0], offset, share, s.value[i.field], along); });
                break;
            case Instruction::call: break;
        }
    }
};

}  // namespace tc
