// A loop over triangles, vertices or points: numbers are gathered into registers, kernels run on whole packs of items,
// and results are scattered. The reverse sweep and the tangents go through the same instructions.
#pragma once

#include "shares.h"

namespace tc {

template <class R>
struct Loop : Stage<R>, Shares<R> {
    using typename Moves<R>::P;
    using Shares<R>::share, Shares<R>::work;
    using Moves<R>::L, Moves<R>::program, Moves<R>::code, Moves<R>::index, Moves<R>::span, Moves<R>::count;
    using Moves<R>::pick, Moves<R>::fix, Moves<R>::copy, Moves<R>::packed, Moves<R>::look;
    using Moves<R>::gather, Moves<R>::add, Moves<R>::store, Moves<R>::take, Moves<R>::gather_along, Moves<R>::scatter_along;

    const Kernel<R>* kernels;
    bool flat;  // what it gives has no derivative

    Loop(const Program<R>& p, const Kernel<R>* k, int n, int list, int counted, bool flat)
        : Shares<R>{{p, n, list, counted, {}, {}}}, kernels(k), flat(flat) {}

    void ready() override {
        for (const Instruction& i : code) {
            const bool transfers = i.code == Instruction::spread || i.code == Instruction::collect;
            work += transfers ? 600 : i.code == Instruction::call ? kernels[i.kernel].flops : 10 * i.comps;
        }
    }
    double cost(const Scene<R>& s) const override {
        const int kind = Moves<R>::counted;  // of what contact counts, only points go on from substep to substep
        const int items = Moves<R>::list >= 0 || kind > 0 ? 0 : kind == 0 ? s.counts[kind] : Moves<R>::items;
        return items * work * (s.bars.size ? 3 : s.dots.size ? 5 : 1);
    }

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
        const Span all = span(s);
        if (all.items == 0) return;
        fix(s, all);
        share(s, all, Way::value, [&](const View<R>& at, const Span& all, int begin, int end) {
            for (const Instruction& i : code) if (is_shared(i)) gather(i, at.value[i.field], at.regs, 0, all);
            for (int first = begin; first < end; first += L) {
                pick(all, at.picked, first);
                for (const Instruction& i : code)
                    if (!again || !is_recorded(i)) compute(s, at, i, first, all);
            }
        });
    }
    bool is_recorded(const Instruction& i) const {
        if (i.code != Instruction::add && i.code != Instruction::put) return false;
        const Kind kind = program.fields[i.field].kind;
        return kind != Kind::temporary && kind != Kind::nodes && kind != Kind::points;
    }
    TC_INLINE void compute(const Scene<R>& s, const View<R>& at, const Instruction& i, int first, const Span& all) const {
        R* field = i.field >= 0 ? at.value[i.field] : nullptr;
        P* regs = at.regs;
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
        const Span all = span(s);
        if (flat || all.items == 0) return;
        fix(s, all);
        share(s, all, Way::reverse, [&](const View<R>& at, const Span& all, int begin, int end) {
            P *regs = at.regs, *bars = at.bars;
            for (const Instruction& i : code)
                if (is_shared(i)) {
                    gather(i, at.value[i.field], regs, 0, all);
                    zero(bars, i.reg, i.comps);
                }
            for (int first = begin; first < end; first += L) {
                pick(all, at.picked, first);
                for (const Instruction& i : code) {
                    const bool gives = i.code == Instruction::call || i.code == Instruction::collect;
                    if (gives ? i.feeds : i.code == Instruction::load || i.code == Instruction::lookup) compute(s, at, i, first, all);
                    if (i.code == Instruction::load && !is_shared(i)) zero(bars, i.reg, i.comps);
                    else if (i.code == Instruction::lookup) zero(bars, i.out[0], CELL);
                    else if (i.code == Instruction::collect) zero(bars, i.in[1], SHARES);
                    else if (i.code == Instruction::call) for (int o : i.out) if (o >= 0) bars[o] = P(0.0);
                }
                for (auto i = code.rbegin(); i != code.rend(); ++i) back(at, *i, first, all);
            }
            for (const Instruction& i : code)
                if (is_shared(i) && at.bar[i.field])
                    for (int c = 0; c < i.comps; c++) at.bar[i.field][c] += total(bars[i.reg + c]);
        });
    }
    TC_INLINE void back(const View<R>& at, const Instruction& i, int first, const Span& all) const {
        R* bar = i.field >= 0 ? at.bar[i.field] : nullptr;
        P *regs = at.regs, *bars = at.bars;
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
                    t.spread_and_weigh(regs + i.in[0], bars + i.in[1], bar, at.value[i.field], bars + i.in[0]);
                });
                break;
        }
    }
    void tangent(Scene<R>& s) const override {
        if (flat) return forward(s);
        at_once(s.directions, [&](auto n) { tangent_along<n>(s); });
    }
    template <int N>
    void tangent_along(Scene<R>& s) const {
        using D = Along<R, N>;
        const Span all = span(s);
        if (all.items == 0) return;
        fix(s, all);
        share(s, all, Way::tangent, [&](const View<R>& at, const Span& all, int begin, int end) {
            D* dots = reinterpret_cast<D*>(at.dots);
            for (const Instruction& i : code)  // what has no tangent
                if (i.code == Instruction::load && at.dot[i.field] == nullptr)
                    std::memset(static_cast<void*>(dots + size_t(i.reg) * L), 0, size_t(i.comps) * L * sizeof(D));
            for (const Instruction& i : code)
                if (is_shared(i)) {
                    gather(i, at.value[i.field], at.regs, 0, all);
                    gather_along(i, at.dot[i.field], dots, 0, all);
                }
            for (int first = begin; first < end; first += L) {
                pick(all, at.picked, first);
                for (const Instruction& i : code) compute_along<N>(s, at, dots, i, first, all);
            }
        });
    }
    template <int N>
    struct Ahead {
        template <class T, By BY>
        using Transfer = TransferAlong<T, BY, N>;
    };
    template <int N>
    TC_INLINE void compute_along(const Scene<R>& s, const View<R>& at, Along<R, N>* dots, const Instruction& i, int first, const Span& all) const {
        using D = Along<R, N>;
        R *field = i.field >= 0 ? at.value[i.field] : nullptr, *along = i.field >= 0 ? at.dot[i.field] : nullptr;
        P* regs = at.regs;
        switch (i.code) {
            case Instruction::call: kernels[i.kernel].tangent(regs, dots, i.in.data(), i.out.data()); break;
            case Instruction::spread:
                transfer<Ahead<N>::template Transfer>(i, first, all, [&](auto t) {
                    t.spread(regs + i.in[0], dots + i.in[0] * L, regs + i.in[1], dots + i.in[1] * L, field, along);
                });
                break;
            case Instruction::collect:
                transfer<Ahead<N>::template Transfer>(i, first, all, [&](auto t) {
                    t.collect(regs + i.in[0], dots + i.in[0] * L, regs + i.in[1], dots + i.in[1] * L, field, along);
                });
                break;
            case Instruction::load:
                compute(s, at, i, first, all);
                if (!is_shared(i)) gather_along(i, along, dots, first, all);
                break;
            case Instruction::add:
            case Instruction::put:
                compute(s, at, i, first, all);
                scatter_along(i, along, dots, first, i.code == Instruction::add, all);
                break;
            case Instruction::lookup:
                compute(s, at, i, first, all);
                for (int k = 0; k < CELL * L; k++) dots[i.out[0] * L + k] = k < 3 * L ? dots[i.in[0] * L + k] : D(0.0);
                break;
        }
    }
};

}  // namespace tc
