// A loop over triangles, vertices or points: numbers are gathered into registers, kernels run on whole packs of items or
// of scenes, and results are scattered. The reverse sweep and the tangents go through the same instructions.
#pragma once

#include "parallel_reduce.h"
#include "scene_lanes.h"

namespace tc {

template <class R>
struct Loop : Stage<R>, ParallelReduce<R> {
    using typename GatherScatter<R>::P;
    using ParallelReduce<R>::run_parallel, ParallelReduce<R>::ops_per_item;
    using Base = GatherScatter<R>;
    using Base::L, Base::program, Base::code, Base::index, Base::span, Base::count;
    using Base::prepare_rows, Base::gather_invariants, Base::gather, Base::gather_jvp, Base::scatter_jvp;

    const Kernel<R>* kernels;
    bool no_derivative;  // of its results

    Loop(const Program<R>& p, const Kernel<R>* k, int n, int point_list, int contact_points, bool no_derivative)
        : ParallelReduce<R>{{p, n, point_list, contact_points, {}, {}}}, kernels(k), no_derivative(no_derivative) {}

    void finish() override {
        Base::order_nearby();
        for (const Instruction& i : code) {
            const bool transfers = i.code == Opcode::p2g || i.code == Opcode::g2p;
            ops_per_item += transfers ? 600 : i.code == Opcode::call ? kernels[i.kernel].flops : 10 * i.comps;
        }
    }
    double cost(const Scene<R>& s) const override {
        // of contact points, only the active ones persist from substep to substep
        const int kind = Base::contact_points, active = contact_count::active;
        const int items = Base::point_list >= 0 || kind > active ? 0
                          : kind == active                       ? s.contact_counts[kind]
                                                                 : Base::items;
        return items * ops_per_item * s.lanes * (s.bars.size ? 3 : s.dots.size ? 5 : 1);
    }

    // Calls f(access), which reads and writes fields: with items or with scenes in the lanes.
    template <class F>
    TC_INLINE void with_access(const Scene<R>& s, F f) const {
        if (s.lanes > 1) f(SceneLanes<R>{*this});
        else f(items());
    }
    const GatherScatter<R>& items() const { return *this; }

    bool is_shared(const Instruction& i) const { return i.code == Opcode::load && i.table == SINGLE_ROW; }

    // Calls f(transfer) for the points of a pack.
    template <template <class, TransferBasis> class Of, class F>
    TC_INLINE void transfer(const Instruction& i, int first, const ItemSpan& s, F f) const {
        const int *nodes = index(i, s) + size_t(first) * BLOCKS_PER_POINT, lanes = count(first, s);
        if (TransferBasis(i.in[2]) == TransferBasis::gradient) f(Of<R, TransferBasis::gradient>{nodes, lanes});
        else f(Of<R, TransferBasis::affine>{nodes, lanes});
    }
    static void zero(P* registers, int first, int count) {
        for (int r = 0; r < count; r++) registers[first + r] = P(0.0);
    }

    void forward(Scene<R>& s) const override { run_values(s, false); }
    void replay(Scene<R>& s) const override { run_values(s, true); }
    void run_values(Scene<R>& s, bool replayed) const {
        with_access(s, [&](const auto& access) { run_values(s, access, replayed); });
    }
    template <class Access>
    void run_values(Scene<R>& s, const Access& access, bool replayed) const {
        const ItemSpan all = access.span(s);
        if (all.items == 0) return;
        access.gather_invariants(s, all);
        auto run = [&](const ThreadView<R>& at, const ItemSpan& all, int begin, int end) {
            for (const Instruction& i : code) if (is_shared(i)) access.gather_shared(i, at.value[i.field], at.regs, all);
            for (int first = begin; first < end; first += Access::ITEMS) {
                access.prepare_rows(all, at.picked, first);
                for (const Instruction& i : code)
                    if (!replayed || !is_recorded_store(i)) compute(s, access, at, i, first, all);
            }
        };
        run_parallel(s, all, RunMode::values, Access::ITEMS, run);
    }
    bool is_recorded_store(const Instruction& i) const {
        if (i.code != Opcode::add && i.code != Opcode::store) return false;
        const FieldKind kind = program.fields[i.field].kind;
        return kind != FieldKind::temporary && kind != FieldKind::nodes && kind != FieldKind::points;
    }
    template <class Access>
    TC_INLINE void compute(const Scene<R>& s, const Access& access, const ThreadView<R>& at, const Instruction& i,
                           int first, const ItemSpan& all) const {
        R* field = i.field >= 0 ? at.value[i.field] : nullptr;
        P* regs = at.regs;
        switch (i.code) {
            case Opcode::load: if (!is_shared(i)) access.load(s, i, field, regs, first, all); break;
            case Opcode::call:
                access.for_each_item(first, all, [&](size_t reg) {
                    kernels[i.kernel].value(regs + reg, i.in.data(), i.out.data());
                });
                break;
            case Opcode::add: access.add(i, field, regs, first, all); break;
            case Opcode::store: access.store(i, field, regs, first, all); break;
            case Opcode::lookup:
                access.for_each_item(first, all, [&](size_t reg) { Base::grid_lookup(i, field, regs + reg); });
                break;
            case Opcode::p2g:
                transfer<Transfer>(i, first, all, [&](auto t) { t.p2g(regs + i.in[0], regs + i.in[1], field); });
                break;
            case Opcode::g2p:
                transfer<Transfer>(i, first, all, [&](auto t) { t.g2p(regs + i.in[0], regs + i.in[1], field); });
                break;
        }
    }

    void reverse(Scene<R>& s) const override {
        if (!no_derivative) with_access(s, [&](const auto& access) { run_adjoints(s, access); });
    }
    template <class Access>
    void run_adjoints(Scene<R>& s, const Access& access) const {
        const ItemSpan all = access.span(s);
        if (all.items == 0) return;
        access.gather_invariants(s, all);
        auto run = [&](const ThreadView<R>& at, const ItemSpan& all, int begin, int end) {
            P *regs = at.regs, *bars = at.bars;
            for (const Instruction& i : code)
                if (is_shared(i)) {
                    access.gather_shared(i, at.value[i.field], regs, all);
                    access.for_each_register_set([&](size_t reg) { zero(bars + reg, i.reg, i.comps); });
                }
            for (int first = begin; first < end; first += Access::ITEMS) {
                access.prepare_rows(all, at.picked, first);
                for (const Instruction& i : code) {
                    const bool has_results = i.code == Opcode::call || i.code == Opcode::g2p;
                    if (has_results ? i.is_needed : i.code == Opcode::load || i.code == Opcode::lookup)
                        compute(s, access, at, i, first, all);
                    access.for_each_item(first, all, [&](size_t reg) { zero_results(i, bars + reg); });
                }
                for (auto i = code.rbegin(); i != code.rend(); ++i) reverse_instruction(access, at, *i, first, all);
            }
            for (const Instruction& i : code)
                if (is_shared(i) && at.bar[i.field]) access.add_shared(i, at.bar[i.field], bars);
        };
        run_parallel(s, all, RunMode::adjoints, Access::ITEMS, run);
    }
    void zero_results(const Instruction& i, P* bars) const {
        if (i.code == Opcode::load && !is_shared(i)) zero(bars, i.reg, i.comps);
        else if (i.code == Opcode::lookup) zero(bars, i.out[0], LOOKUP_REGISTERS);
        else if (i.code == Opcode::g2p) zero(bars, i.in[1], TRANSFER_SHARES);
        else if (i.code == Opcode::call) for (int o : i.out) if (o >= 0) bars[o] = P(0.0);
    }
    template <class Access>
    TC_INLINE void reverse_instruction(const Access& access, const ThreadView<R>& at, const Instruction& i, int first,
                                       const ItemSpan& all) const {
        R* bar = i.field >= 0 ? at.bar[i.field] : nullptr;
        P *regs = at.regs, *bars = at.bars;
        switch (i.code) {
            case Opcode::add:
            case Opcode::store: access.scatter_adjoint(i, bar, bars, first, all); break;
            case Opcode::call:
                access.for_each_item(first, all, [&](size_t reg) {
                    kernels[i.kernel].adjoint(regs + reg, bars + reg, i.in.data(), i.out.data());
                });
                break;
            case Opcode::load: if (!is_shared(i) && bar) access.add(i, bar, bars, first, all); break;
            case Opcode::lookup:
                access.for_each_item(first, all, [&](size_t reg) {
                    P *to = bars + reg + i.in[0], *from = bars + reg + i.out[0];
                    for (int k = 0; k < 3; k++) to[k] = to[k] + from[k];
                });
                break;
            case Opcode::p2g:
                transfer<Transfer>(i, first, all, [&](auto t) {
                    t.p2g_adjoint(regs + i.in[0], regs + i.in[1], bar, bars + i.in[1], bars + i.in[0]);
                });
                break;
            case Opcode::g2p:
                transfer<Transfer>(i, first, all, [&](auto t) {
                    t.g2p_adjoint(regs + i.in[0], bars + i.in[1], bar, at.value[i.field], bars + i.in[0]);
                });
                break;
        }
    }
    void tangent(Scene<R>& s) const override {
        if (no_derivative) return forward(s);
        with_direction_count(s.directions, [&](auto n) { tangent_of<n>(s); });
    }
    template <int N>
    void tangent_of(Scene<R>& s) const {
        using D = DirectionPack<R, N>;
        const ItemSpan all = span(s);
        if (all.items == 0) return;
        gather_invariants(s, all);
        run_parallel(s, all, RunMode::tangents, L, [&](const ThreadView<R>& at, const ItemSpan& all, int begin, int end) {
            D* dots = reinterpret_cast<D*>(at.dots);
            for (const Instruction& i : code)  // what has no tangent
                if (i.code == Opcode::load && at.dot[i.field] == nullptr)
                    std::memset(static_cast<void*>(dots + size_t(i.reg) * L), 0, size_t(i.comps) * L * sizeof(D));
            for (const Instruction& i : code)
                if (is_shared(i)) {
                    gather(i, at.value[i.field], at.regs, 0, all);
                    gather_jvp(i, at.dot[i.field], dots, 0, all);
                }
            for (int first = begin; first < end; first += L) {
                prepare_rows(all, at.picked, first);
                for (const Instruction& i : code) compute_jvp<N>(s, at, dots, i, first, all);
            }
        });
    }
    template <int N>
    struct JvpTransfer {
        template <class T, TransferBasis BASIS>
        using Transfer = TransferJvp<T, BASIS, N>;
    };
    template <int N>
    TC_INLINE void compute_jvp(const Scene<R>& s, const ThreadView<R>& at, DirectionPack<R, N>* dots,
                               const Instruction& i, int first, const ItemSpan& all) const {
        using D = DirectionPack<R, N>;
        R *field = i.field >= 0 ? at.value[i.field] : nullptr, *along = i.field >= 0 ? at.dot[i.field] : nullptr;
        P* regs = at.regs;
        switch (i.code) {
            case Opcode::call: kernels[i.kernel].tangent(regs, dots, i.in.data(), i.out.data()); break;
            case Opcode::p2g:
                transfer<JvpTransfer<N>::template Transfer>(i, first, all, [&](auto t) {
                    t.p2g(regs + i.in[0], dots + i.in[0] * L, regs + i.in[1], dots + i.in[1] * L, field, along);
                });
                break;
            case Opcode::g2p:
                transfer<JvpTransfer<N>::template Transfer>(i, first, all, [&](auto t) {
                    t.g2p(regs + i.in[0], dots + i.in[0] * L, regs + i.in[1], dots + i.in[1] * L, field, along);
                });
                break;
            case Opcode::load:
                compute(s, items(), at, i, first, all);
                if (!is_shared(i)) gather_jvp(i, along, dots, first, all);
                break;
            case Opcode::add:
            case Opcode::store:
                compute(s, items(), at, i, first, all);
                scatter_jvp(i, along, dots, first, i.code == Opcode::add, all);
                break;
            case Opcode::lookup:
                compute(s, items(), at, i, first, all);
                for (int k = 0; k < LOOKUP_REGISTERS * L; k++)
                    dots[i.out[0] * L + k] = k < 3 * L ? dots[i.in[0] * L + k] : D(0.0);
                break;
        }
    }
};

}  // namespace tc
