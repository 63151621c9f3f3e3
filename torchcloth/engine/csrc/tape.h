// Derivatives of kernels, made by the compiler.
//
// A kernel is a plain function of numbers, written once:
//
//     struct Cube {
//         static constexpr const char* name = "cube";
//         static constexpr int inputs = 1, outputs = 1;
//         template <class T> static constexpr void run(const T* in, T* out) { out[0] = in[0] * in[0] * in[0]; }
//     };
//
// At compile time it is run once with `TracedScalar`, which records its operations (a Wengert tape). The list is a
// constant, so values, adjoints and tangents unfold into straight-line code without a tape at run time. Kernels must
// not branch on numbers; use `select(less(a, b), x, y)` instead. Derivatives of at_least and at_most pass where the
// bound is met exactly.
#pragma once

#include <cstdint>
#include <type_traits>
#include <utility>

#include "pack_math.h"

namespace tc {

struct Node {
    TapeOp op = TapeOp::input;
    int a = -1, b = -1, c = -1;
    double value = 0;
};

constexpr int MAX_OPERATIONS = 4096;

struct Tape {
    Node node[MAX_OPERATIONS]{};
    int size = 0;
    constexpr int push(Node n) { node[size] = n; return size++; }
};

struct TracedScalar {
    Tape* tape = nullptr;
    int id = -1;
};

#define TC_TWO(fn, o)                                           \
    constexpr TracedScalar fn(TracedScalar a, TracedScalar b) { \
        return {a.tape, a.tape->push({TapeOp::o, a.id, b.id})}; \
    }
#define TC_ONE(fn, o) constexpr TracedScalar fn(TracedScalar a) { return {a.tape, a.tape->push({TapeOp::o, a.id})}; }
#define TC_NUM(fn, o) \
    constexpr TracedScalar fn(TracedScalar a, double c) { return {a.tape, a.tape->push({TapeOp::o, a.id, -1, -1, c})}; }
TC_TWO(operator+, add)
TC_TWO(operator-, sub)
TC_TWO(operator*, mul)
TC_TWO(operator/, div)
TC_TWO(less, less)
TC_TWO(atan2, atan2)
TC_ONE(operator-, neg)
TC_ONE(sqrt, sqrt)
TC_ONE(exp, exp)
TC_ONE(expm1, expm1)
TC_ONE(abs, abs)
TC_ONE(detach, detach)
TC_NUM(operator+, addc)
TC_NUM(operator*, mulc)
TC_NUM(at_least, at_least)
TC_NUM(at_most, at_most)
TC_NUM(less, lessc)
TC_NUM(constant, constant)
constexpr TracedScalar operator+(double c, TracedScalar a) { return a + c; }
constexpr TracedScalar operator*(double c, TracedScalar a) { return a * c; }
constexpr TracedScalar operator-(TracedScalar a, double c) { return a + (-c); }
constexpr TracedScalar operator/(TracedScalar a, double c) { return a * (1.0 / c); }
constexpr TracedScalar operator-(double c, TracedScalar a) {
    return {a.tape, a.tape->push({TapeOp::rsubc, a.id, -1, -1, c})};
}
constexpr TracedScalar operator/(double c, TracedScalar a) {
    return {a.tape, a.tape->push({TapeOp::rdivc, a.id, -1, -1, c})};
}
constexpr TracedScalar less(double c, TracedScalar a) {
    return {a.tape, a.tape->push({TapeOp::cless, a.id, -1, -1, c})};
}
constexpr TracedScalar select(TracedScalar c, TracedScalar a, TracedScalar b) {
    return {a.tape, a.tape->push({TapeOp::select, a.id, b.id, c.id})};
}
constexpr TracedScalar select(TracedScalar c, TracedScalar a, double b) { return select(c, a, constant(a, b)); }
constexpr TracedScalar select(TracedScalar c, double a, TracedScalar b) { return select(c, constant(b, a), b); }
#undef TC_TWO
#undef TC_ONE
#undef TC_NUM

// The operations of a kernel, and what is known of them at compile time.
struct Trace {
    Tape tape{};
    int out[256]{};         // node of each output
    int last_user[MAX_OPERATIONS]{};    // last operation that adds to a node's adjoint; -1: none
    bool is_output[MAX_OPERATIONS]{}; // is an output
    bool varies[MAX_OPERATIONS]{}; // depends on an input that is not constant
    int flops = 0;
};

template <class K>
constexpr bool is_constant_input(int input) {
    if constexpr (requires { K::constant_inputs; }) return (K::constant_inputs >> input) & 1;
    return false;
}

template <class K>
constexpr Trace trace() {
    Trace t{};
    TracedScalar in[K::inputs]{}, out[K::outputs]{};
    for (int i = 0; i < K::inputs; i++) in[i] = {&t.tape, t.tape.push({TapeOp::input, i})};
    K::template run<TracedScalar>(in, out);
    for (int& user : t.last_user) user = -1;
    for (int i = 0; i < K::outputs; i++) t.out[i] = out[i].id, t.is_output[out[i].id] = true;
    for (int i = 0; i < t.tape.size; i++) {
        const Node& n = t.tape.node[i];
        if (n.op == TapeOp::input) { t.varies[i] = !is_constant_input<K>(i); continue; }
        if (n.op == TapeOp::constant) continue;
        t.flops++;
        const bool flat =
            n.op == TapeOp::detach || n.op == TapeOp::less || n.op == TapeOp::lessc || n.op == TapeOp::cless;
        t.varies[i] = !flat && (t.varies[n.a] || (n.b >= 0 && t.varies[n.b]));
    }
    for (int i = t.tape.size - 1; i >= 0; i--) {  // only operations that pass an adjoint on are users
        const Node& n = t.tape.node[i];
        if (n.op == TapeOp::input || !t.varies[i] || !(t.is_output[i] || t.last_user[i] >= 0)) continue;
        for (int operand : {n.a, n.b}) if (operand >= 0 && t.last_user[operand] < 0) t.last_user[operand] = i;
    }
    return t;
}

template <class K>
inline constexpr Trace traced = trace<K>();

#define TC_INLINE inline __attribute__((always_inline))
#define TC_APART __attribute__((noinline))  // keeps its stack frame out of small callers

template <class K, int I, class P>
TC_INLINE void forward(P* v) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (n.op == TapeOp::constant) v[I] = P(n.value);
    else if constexpr (n.op == TapeOp::add) v[I] = v[n.a] + v[n.b];
    else if constexpr (n.op == TapeOp::sub) v[I] = v[n.a] - v[n.b];
    else if constexpr (n.op == TapeOp::mul) v[I] = v[n.a] * v[n.b];
    else if constexpr (n.op == TapeOp::div) v[I] = v[n.a] / v[n.b];
    else if constexpr (n.op == TapeOp::addc) v[I] = v[n.a] + n.value;
    else if constexpr (n.op == TapeOp::rsubc) v[I] = n.value - v[n.a];
    else if constexpr (n.op == TapeOp::mulc) v[I] = v[n.a] * n.value;
    else if constexpr (n.op == TapeOp::rdivc) v[I] = n.value / v[n.a];
    else if constexpr (n.op == TapeOp::neg) v[I] = -v[n.a];
    else if constexpr (n.op == TapeOp::sqrt) v[I] = sqrt(v[n.a]);
    else if constexpr (n.op == TapeOp::exp) v[I] = exp(v[n.a]);
    else if constexpr (n.op == TapeOp::expm1) v[I] = expm1(v[n.a]);
    else if constexpr (n.op == TapeOp::atan2) v[I] = atan2(v[n.a], v[n.b]);
    else if constexpr (n.op == TapeOp::abs) v[I] = abs(v[n.a]);
    else if constexpr (n.op == TapeOp::at_least) v[I] = at_least(v[n.a], n.value);
    else if constexpr (n.op == TapeOp::at_most) v[I] = at_most(v[n.a], n.value);
    else if constexpr (n.op == TapeOp::less) v[I] = less(v[n.a], v[n.b]);
    else if constexpr (n.op == TapeOp::lessc) v[I] = less(v[n.a], n.value);
    else if constexpr (n.op == TapeOp::cless) v[I] = less(n.value, v[n.a]);
    else if constexpr (n.op == TapeOp::select) v[I] = select(v[n.c], v[n.a], v[n.b]);
    else if constexpr (n.op == TapeOp::detach) v[I] = v[n.a];
}

// Partial derivatives of operation I by its first and second operand, where they are not plain +1 or -1.
template <class K, int I, class P>
TC_INLINE P first_partial(const P* v) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (n.op == TapeOp::mul) return v[n.b];
    else if constexpr (n.op == TapeOp::div) return 1.0 / v[n.b];
    else if constexpr (n.op == TapeOp::mulc) return P(n.value);
    else if constexpr (n.op == TapeOp::rdivc) return -v[I] / v[n.a];
    else if constexpr (n.op == TapeOp::sqrt) return 0.5 / v[I];
    else if constexpr (n.op == TapeOp::exp) return v[I];
    else if constexpr (n.op == TapeOp::expm1) return v[I] + 1.0;
    else if constexpr (n.op == TapeOp::atan2) return v[n.b] / (v[n.a] * v[n.a] + v[n.b] * v[n.b]);
    else if constexpr (n.op == TapeOp::abs)
        return select(less(0.0, v[n.a]), P(1.0), select(less(v[n.a], 0.0), P(-1.0), P(0.0)));
    else if constexpr (n.op == TapeOp::at_least) return 1.0 - less(v[n.a], n.value);
    else if constexpr (n.op == TapeOp::at_most) return 1.0 - less(n.value, v[n.a]);
    else return P(1.0);
}

template <class K, int I, class P>
TC_INLINE P second_partial(const P* v) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (n.op == TapeOp::mul) return v[n.a];
    else if constexpr (n.op == TapeOp::div) return -v[I] * (1.0 / v[n.b]);  // common with the first partial
    else return -v[n.a] / (v[n.a] * v[n.a] + v[n.b] * v[n.b]);  // atan2
}

constexpr bool is_linear(TapeOp op) {
    return op == TapeOp::add || op == TapeOp::sub || op == TapeOp::addc || op == TapeOp::rsubc || op == TapeOp::neg;
}
constexpr bool is_second_nonlinear(TapeOp op) { return op == TapeOp::mul || op == TapeOp::div || op == TapeOp::atan2; }

// ---- reverse -------------------------------------------------------------------------------------------------------

// Adds to the adjoint of node A. Its last user comes first in the reverse sweep, and sets it.
template <class K, int I, int A, bool second, class P>
TC_INLINE void accumulate_adjoint(P* g, P x) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (traced<K>.last_user[A] == I && !traced<K>.is_output[A] && !(second && n.a == A)) g[A] = x;
    else g[A] = g[A] + x;
}

template <class K, int I, class P>
TC_INLINE void reverse(const P* v, P* g) {
    constexpr Node n = traced<K>.tape.node[I];
    constexpr const Trace& t = traced<K>;
    if constexpr (t.varies[I] && n.op != TapeOp::input && (t.is_output[I] || t.last_user[I] >= 0)) {
        if constexpr (n.op == TapeOp::select) {
            accumulate_adjoint<K, I, n.a, false>(g, select(v[n.c], g[I], 0.0));
            accumulate_adjoint<K, I, n.b, true>(g, select(v[n.c], 0.0, g[I]));
        } else {
            if constexpr (t.varies[n.a]) {
                if constexpr (n.op == TapeOp::rsubc || n.op == TapeOp::neg)
                    accumulate_adjoint<K, I, n.a, false>(g, -g[I]);
                else if constexpr (is_linear(n.op)) accumulate_adjoint<K, I, n.a, false>(g, g[I]);
                else accumulate_adjoint<K, I, n.a, false>(g, g[I] * first_partial<K, I>(v));
            } else if constexpr (n.b == n.a) {
            }
            if constexpr (n.b >= 0) if constexpr (t.varies[n.b]) {
                if constexpr (n.op == TapeOp::add) accumulate_adjoint<K, I, n.b, true>(g, g[I]);
                else if constexpr (n.op == TapeOp::sub) accumulate_adjoint<K, I, n.b, true>(g, -g[I]);
                else accumulate_adjoint<K, I, n.b, true>(g, g[I] * second_partial<K, I>(v));
            }
        }
    }
}

template <class K, class P, int... I>
TC_INLINE void all_forward(P* v, std::integer_sequence<int, I...>) { (forward<K, I>(v), ...); }
template <class K, class P, int... I>
TC_INLINE void all_reverse(const P* v, P* g, std::integer_sequence<int, I...>) {
    constexpr int last = int(sizeof...(I)) - 1;
    (reverse<K, last - I>(v, g), ...);
}

template <class K>
using Operations = std::make_integer_sequence<int, traced<K>.tape.size>;

// Registers are rows of a table of packs. An output ~index adds to its register instead of setting it.
template <class K, class R>
void value(Wide<R>* regs, const int* in, const int* out) {
    Wide<R> a[K::inputs], b[K::outputs];
    for (int i = 0; i < K::inputs; i++) a[i] = regs[in[i]];
    K::template run<Wide<R>>(a, b);
    for (int i = 0; i < K::outputs; i++)
        if (out[i] >= 0) regs[out[i]] = b[i];
        else regs[~out[i]] = regs[~out[i]] + b[i];
}

template <class K, class R>
void adjoint(const Wide<R>* regs, Wide<R>* bar, const int* in, const int* out) {
    using P = Wide<R>;
    constexpr const Trace& t = traced<K>;
    P v[t.tape.size], g[t.tape.size];
    for (int i = 0; i < K::inputs; i++) v[i] = regs[in[i]];
    all_forward<K>(v, Operations<K>{});
    for (int i = 0; i < t.tape.size; i++) if (t.is_output[i] || t.last_user[i] < 0) g[i] = P(0.0);
    for (int i = 0; i < K::outputs; i++) g[t.out[i]] = g[t.out[i]] + bar[out[i] >= 0 ? out[i] : ~out[i]];
    all_reverse<K>(v, g, Operations<K>{});
    for (int i = 0; i < K::inputs; i++) if (t.varies[i]) bar[in[i]] = bar[in[i]] + g[i];
}

// ---- forward tangents ----------------------------------------------------------------------------------------------

// Directions of a group. Each group computes the values as well, and few directions would leave a wide group empty.
constexpr int NARROW_DIRECTIONS = 4, WIDE_DIRECTIONS = 8;
template <class R, int N>
using DirectionPack = Pack<R, N>;

// Calls f(number of directions), with the number as a constant.
template <class F>
TC_INLINE void with_direction_count(int directions, F f) {
    if (directions == NARROW_DIRECTIONS) f(std::integral_constant<int, NARROW_DIRECTIONS>{});
    else f(std::integral_constant<int, WIDE_DIRECTIONS>{});
}

// Items whose directions lie next to each other in a pack.
template <class R, int N>
constexpr int ITEMS_PER_PACK = LANES<R> / N;

// Repeats the number of each item for all its directions; items are the lanes `first`, first + 1, ... of a pack.
template <class R, int N>
struct BroadcastItems {
    typedef std::conditional_t<sizeof(R) == 4, int32_t, int64_t> Index;
    typedef Index Indices __attribute__((vector_size(WIDTH)));
    Indices index;
    explicit BroadcastItems(int first) {
        for (int i = 0; i < LANES<R>; i++) index[i] = first + i / N;
    }
    Wide<R> operator()(const Wide<R>& pack) const {
        if constexpr (ITEMS_PER_PACK<R, N> == 1) return Wide<R>(typename Wide<R>::Lanes{} + pack.v[index[0]]);
        typename Wide<R>::Lanes out;
#ifdef __clang__  // compiles the loop to one permutation
        for (int i = 0; i < LANES<R>; i++) out[i] = pack.v[index[i]];
#else
        out = __builtin_shuffle(pack.v, index);
#endif
        return Wide<R>(out);
    }
};

// Partial derivatives of all lanes at once. The lanes then go through the operations with their directions next to each
// other.
template <class K, int I, class P>
TC_INLINE void partials(const P* v, P* p, P* q) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (traced<K>.varies[I] && n.op != TapeOp::input && n.op != TapeOp::select && !is_linear(n.op)) {
        if constexpr (n.op != TapeOp::mul && n.op != TapeOp::mulc) p[I] = first_partial<K, I>(v);
        if constexpr (n.op == TapeOp::div || n.op == TapeOp::atan2) q[I] = second_partial<K, I>(v);
    }
}

template <class K, int I, class P, class Number>
TC_INLINE void jvp(const P* v, const P* p, const P* q, Number number, P* t) {
    constexpr Node n = traced<K>.tape.node[I];
    constexpr const Trace& k = traced<K>;
    if constexpr (k.varies[I] && n.op != TapeOp::input) {
        if constexpr (n.op == TapeOp::select) {
            const P a = k.varies[n.a] ? t[n.a] : P(0.0), b = k.varies[n.b] ? t[n.b] : P(0.0);
            t[I] = select(number(v[n.c]), a, b);
        } else if constexpr (n.op == TapeOp::mulc) t[I] = t[n.a] * n.value;
        else if constexpr (n.op == TapeOp::rsubc || n.op == TapeOp::neg) t[I] = -t[n.a];
        else if constexpr (n.op == TapeOp::addc) t[I] = t[n.a];
        else if constexpr (n.b < 0) t[I] = t[n.a] * number(p[I]);
        else if constexpr (n.op == TapeOp::add) {
            if constexpr (k.varies[n.a] && k.varies[n.b]) t[I] = t[n.a] + t[n.b];
            else t[I] = t[k.varies[n.a] ? n.a : n.b];
        } else if constexpr (n.op == TapeOp::sub) {
            if constexpr (k.varies[n.a] && k.varies[n.b]) t[I] = t[n.a] - t[n.b];
            else if constexpr (k.varies[n.a]) t[I] = t[n.a];
            else t[I] = -t[n.b];
        } else {
            constexpr bool product = n.op == TapeOp::mul;
            if constexpr (k.varies[n.a] && k.varies[n.b])
                t[I] = t[n.a] * number(product ? v[n.b] : p[I]) + t[n.b] * number(product ? v[n.a] : q[I]);
            else if constexpr (k.varies[n.a]) t[I] = t[n.a] * number(product ? v[n.b] : p[I]);
            else t[I] = t[n.b] * number(product ? v[n.a] : q[I]);
        }
    }
}

template <class K, class P, int... I>
TC_INLINE void all_partials(const P* v, P* p, P* q, std::integer_sequence<int, I...>) {
    (partials<K, I>(v, p, q), ...);
}
template <class K, class P, class Number, int... I>
TC_INLINE void all_jvp(const P* v, const P* p, const P* q, Number number, P* t, std::integer_sequence<int, I...>) {
    (jvp<K, I>(v, p, q, number, t), ...);
}

template <class K, class R, int N>
void tangent(Wide<R>* regs, DirectionPack<R, N>* dots, const int* in, const int* out) {
    using P = Wide<R>;
    constexpr const Trace& k = traced<K>;
    constexpr int L = LANES<R>;
    P v[k.tape.size], p[k.tape.size], q[k.tape.size];
    for (int i = 0; i < K::inputs; i++) v[i] = regs[in[i]];
    all_forward<K>(v, Operations<K>{});
    all_partials<K>(v, p, q, Operations<K>{});
    auto place = [&](int reg, int lane) -> P& { return *reinterpret_cast<P*>(dots + reg * L + lane); };
    for (int lane = 0; lane < L; lane += ITEMS_PER_PACK<R, N>) {
        P t[k.tape.size];
        for (int i = 0; i < K::inputs; i++) if (k.varies[i]) t[i] = place(in[i], lane);
        all_jvp<K>(v, p, q, BroadcastItems<R, N>(lane), t, Operations<K>{});
        for (int i = 0; i < K::outputs; i++) {
            const P result = k.varies[k.out[i]] ? t[k.out[i]] : P(0.0);
            P& target = place(out[i] >= 0 ? out[i] : ~out[i], lane);
            target = out[i] >= 0 ? result : target + result;
        }
    }
    for (int i = 0; i < K::outputs; i++)
        if (out[i] >= 0) regs[out[i]] = v[k.out[i]];
        else regs[~out[i]] = regs[~out[i]] + v[k.out[i]];
}

// ---- entry points ----------------------------------------------------------------------------------------

// A kernel's operations as plain numbers, for engine/cuda, which compiles them for a device.
struct KernelListing {
    const Node* nodes;
    const bool* varies;
    const int* out;
    int size;
};
template <class K>
struct CompactTrace {  // the trace without unused entries
    static constexpr int size = traced<K>.tape.size;
    Node nodes[size]{};
    bool varies[size]{};
    int out[K::outputs]{};
    constexpr CompactTrace() {
        for (int i = 0; i < size; i++) nodes[i] = traced<K>.tape.node[i], varies[i] = traced<K>.varies[i];
        for (int i = 0; i < K::outputs; i++) out[i] = traced<K>.out[i];
    }
};
template <class K>
inline constexpr CompactTrace<K> compact_trace{};

template <class R>
struct Kernel {
    const char* name;
    int inputs, outputs, flops;
    KernelListing listing;
    void (*value)(Wide<R>*, const int*, const int*);
    void (*adjoint)(const Wide<R>*, Wide<R>*, const int*, const int*);
    void (*jvp4)(Wide<R>*, DirectionPack<R, NARROW_DIRECTIONS>*, const int*, const int*);
    void (*jvp8)(Wide<R>*, DirectionPack<R, WIDE_DIRECTIONS>*, const int*, const int*);
    void tangent(Wide<R>* regs, DirectionPack<R, NARROW_DIRECTIONS>* dots, const int* in, const int* out) const {
        jvp4(regs, dots, in, out);
    }
    void tangent(Wide<R>* regs, DirectionPack<R, WIDE_DIRECTIONS>* dots, const int* in, const int* out) const {
        jvp8(regs, dots, in, out);
    }
};

template <class K, class R>
constexpr Kernel<R> kernel() {
    constexpr const CompactTrace<K>& c = compact_trace<K>;
    return {K::name, K::inputs, K::outputs, traced<K>.flops, {c.nodes, c.varies, c.out, c.size}, value<K, R>,
            adjoint<K, R>, tangent<K, R, NARROW_DIRECTIONS>, tangent<K, R, WIDE_DIRECTIONS>};
}

}  // namespace tc
