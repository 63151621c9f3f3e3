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
// At compile time it is run once with `Sym`, which writes down its operations; the list is a constant, so values,
// adjoints and tangents unfold into straight code without any tape at run time. Kernels must not branch on numbers:
// `select(less(a, b), x, y)` instead. Derivatives of at_least and at_most pass where the bound is met exactly.
#pragma once

#include <cstdint>
#include <type_traits>
#include <utility>

#include "functions.h"

namespace tc {

enum class Op : uint8_t { input, constant, add, sub, mul, div, addc, rsubc, mulc, rdivc, neg, sqrt, exp, expm1, atan2,
                          abs, at_least, at_most, less, lessc, cless, select, detach };

struct Node {
    Op op = Op::input;
    int a = -1, b = -1, c = -1;
    double value = 0;
};

constexpr int LONGEST = 4096;

struct Tape {
    Node node[LONGEST]{};
    int size = 0;
    constexpr int push(Node n) { node[size] = n; return size++; }
};

struct Sym {
    Tape* tape = nullptr;
    int id = -1;
};

#define TC_TWO(fn, o) constexpr Sym fn(Sym a, Sym b) { return {a.tape, a.tape->push({Op::o, a.id, b.id})}; }
#define TC_ONE(fn, o) constexpr Sym fn(Sym a) { return {a.tape, a.tape->push({Op::o, a.id})}; }
#define TC_NUM(fn, o) constexpr Sym fn(Sym a, double c) { return {a.tape, a.tape->push({Op::o, a.id, -1, -1, c})}; }
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
constexpr Sym operator+(double c, Sym a) { return a + c; }
constexpr Sym operator*(double c, Sym a) { return a * c; }
constexpr Sym operator-(Sym a, double c) { return a + (-c); }
constexpr Sym operator/(Sym a, double c) { return a * (1.0 / c); }
constexpr Sym operator-(double c, Sym a) { return {a.tape, a.tape->push({Op::rsubc, a.id, -1, -1, c})}; }
constexpr Sym operator/(double c, Sym a) { return {a.tape, a.tape->push({Op::rdivc, a.id, -1, -1, c})}; }
constexpr Sym less(double c, Sym a) { return {a.tape, a.tape->push({Op::cless, a.id, -1, -1, c})}; }
constexpr Sym select(Sym c, Sym a, Sym b) { return {a.tape, a.tape->push({Op::select, a.id, b.id, c.id})}; }
constexpr Sym select(Sym c, Sym a, double b) { return select(c, a, constant(a, b)); }
constexpr Sym select(Sym c, double a, Sym b) { return select(c, constant(b, a), b); }
#undef TC_TWO
#undef TC_ONE
#undef TC_NUM

// What is known of a kernel before it runs.
struct Trace {
    Tape tape{};
    int out[256]{};         // node of each output
    int last[LONGEST]{};    // last operation that gives a node an adjoint; -1: none
    bool seeded[LONGEST]{}; // is an output
    bool varies[LONGEST]{}; // depends on an input that is not fixed
    int flops = 0;
};

template <class K>
constexpr bool is_fixed(int input) {
    if constexpr (requires { K::fixed; }) return (K::fixed >> input) & 1;
    return false;
}

template <class K>
constexpr Trace trace() {
    Trace t{};
    Sym in[K::inputs]{}, out[K::outputs]{};
    for (int i = 0; i < K::inputs; i++) in[i] = {&t.tape, t.tape.push({Op::input, i})};
    K::template run<Sym>(in, out);
    for (int& user : t.last) user = -1;
    for (int i = 0; i < K::outputs; i++) t.out[i] = out[i].id, t.seeded[out[i].id] = true;
    for (int i = 0; i < t.tape.size; i++) {
        const Node& n = t.tape.node[i];
        if (n.op == Op::input) { t.varies[i] = !is_fixed<K>(i); continue; }
        if (n.op == Op::constant) continue;
        t.flops++;
        const bool flat = n.op == Op::detach || n.op == Op::less || n.op == Op::lessc || n.op == Op::cless;
        t.varies[i] = !flat && (t.varies[n.a] || (n.b >= 0 && t.varies[n.b]));
    }
    for (int i = t.tape.size - 1; i >= 0; i--) {  // only those that hand an adjoint on count as users
        const Node& n = t.tape.node[i];
        if (n.op == Op::input || !t.varies[i] || !(t.seeded[i] || t.last[i] >= 0)) continue;
        for (int operand : {n.a, n.b}) if (operand >= 0 && t.last[operand] < 0) t.last[operand] = i;
    }
    return t;
}

template <class K>
inline constexpr Trace traced = trace<K>();

#define TC_INLINE inline __attribute__((always_inline))
#define TC_APART __attribute__((noinline))  // its frame is not needed by what is small around it

template <class K, int I, class P>
TC_INLINE void forward(P* v) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (n.op == Op::constant) v[I] = P(n.value);
    else if constexpr (n.op == Op::add) v[I] = v[n.a] + v[n.b];
    else if constexpr (n.op == Op::sub) v[I] = v[n.a] - v[n.b];
    else if constexpr (n.op == Op::mul) v[I] = v[n.a] * v[n.b];
    else if constexpr (n.op == Op::div) v[I] = v[n.a] / v[n.b];
    else if constexpr (n.op == Op::addc) v[I] = v[n.a] + n.value;
    else if constexpr (n.op == Op::rsubc) v[I] = n.value - v[n.a];
    else if constexpr (n.op == Op::mulc) v[I] = v[n.a] * n.value;
    else if constexpr (n.op == Op::rdivc) v[I] = n.value / v[n.a];
    else if constexpr (n.op == Op::neg) v[I] = -v[n.a];
    else if constexpr (n.op == Op::sqrt) v[I] = sqrt(v[n.a]);
    else if constexpr (n.op == Op::exp) v[I] = exp(v[n.a]);
    else if constexpr (n.op == Op::expm1) v[I] = expm1(v[n.a]);
    else if constexpr (n.op == Op::atan2) v[I] = atan2(v[n.a], v[n.b]);
    else if constexpr (n.op == Op::abs) v[I] = abs(v[n.a]);
    else if constexpr (n.op == Op::at_least) v[I] = at_least(v[n.a], n.value);
    else if constexpr (n.op == Op::at_most) v[I] = at_most(v[n.a], n.value);
    else if constexpr (n.op == Op::less) v[I] = less(v[n.a], v[n.b]);
    else if constexpr (n.op == Op::lessc) v[I] = less(v[n.a], n.value);
    else if constexpr (n.op == Op::cless) v[I] = less(n.value, v[n.a]);
    else if constexpr (n.op == Op::select) v[I] = select(v[n.c], v[n.a], v[n.b]);
    else if constexpr (n.op == Op::detach) v[I] = v[n.a];
}

// Partial derivatives of operation I by its first and second operand, where they are not plain +1 or -1.
template <class K, int I, class P>
TC_INLINE P first_partial(const P* v) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (n.op == Op::mul) return v[n.b];
    else if constexpr (n.op == Op::div) return 1.0 / v[n.b];
    else if constexpr (n.op == Op::mulc) return P(n.value);
    else if constexpr (n.op == Op::rdivc) return -v[I] / v[n.a];
    else if constexpr (n.op == Op::sqrt) return 0.5 / v[I];
    else if constexpr (n.op == Op::exp) return v[I];
    else if constexpr (n.op == Op::expm1) return v[I] + 1.0;
    else if constexpr (n.op == Op::atan2) return v[n.b] / (v[n.a] * v[n.a] + v[n.b] * v[n.b]);
    else if constexpr (n.op == Op::abs) return select(less(0.0, v[n.a]), P(1.0), select(less(v[n.a], 0.0), P(-1.0), P(0.0)));
    else if constexpr (n.op == Op::at_least) return 1.0 - less(v[n.a], n.value);
    else if constexpr (n.op == Op::at_most) return 1.0 - less(n.value, v[n.a]);
    else return P(1.0);
}

template <class K, int I, class P>
TC_INLINE P second_partial(const P* v) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (n.op == Op::mul) return v[n.a];
    else if constexpr (n.op == Op::div) return -v[I] * (1.0 / v[n.b]);  // the first one has that, too
    else return -v[n.a] / (v[n.a] * v[n.a] + v[n.b] * v[n.b]);  // atan2
}

constexpr bool is_linear(Op op) { return op == Op::add || op == Op::sub || op == Op::addc || op == Op::rsubc || op == Op::neg; }
constexpr bool is_second_nonlinear(Op op) { return op == Op::mul || op == Op::div || op == Op::atan2; }

// ---- reverse -------------------------------------------------------------------------------------------------------

// Add to the adjoint of node A; the last user comes first in the reverse sweep and sets it.
template <class K, int I, int A, bool second, class P>
TC_INLINE void give(P* g, P x) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (traced<K>.last[A] == I && !traced<K>.seeded[A] && !(second && n.a == A)) g[A] = x;
    else g[A] = g[A] + x;
}

template <class K, int I, class P>
TC_INLINE void reverse(const P* v, P* g) {
    constexpr Node n = traced<K>.tape.node[I];
    constexpr const Trace& t = traced<K>;
    if constexpr (t.varies[I] && n.op != Op::input && (t.seeded[I] || t.last[I] >= 0)) {
        if constexpr (n.op == Op::select) {
            give<K, I, n.a, false>(g, select(v[n.c], g[I], 0.0));
            give<K, I, n.b, true>(g, select(v[n.c], 0.0, g[I]));
        } else {
            if constexpr (t.varies[n.a]) {
                if constexpr (n.op == Op::rsubc || n.op == Op::neg) give<K, I, n.a, false>(g, -g[I]);
                else if constexpr (is_linear(n.op)) give<K, I, n.a, false>(g, g[I]);
                else give<K, I, n.a, false>(g, g[I] * first_partial<K, I>(v));
            } else if constexpr (n.b == n.a) {
            }
            if constexpr (n.b >= 0) if constexpr (t.varies[n.b]) {
                if constexpr (n.op == Op::add) give<K, I, n.b, true>(g, g[I]);
                else if constexpr (n.op == Op::sub) give<K, I, n.b, true>(g, -g[I]);
                else give<K, I, n.b, true>(g, g[I] * second_partial<K, I>(v));
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

// Registers are rows of a table of packs. Outputs with ~index add to their register instead of setting it.
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
    for (int i = 0; i < t.tape.size; i++) if (t.seeded[i] || t.last[i] < 0) g[i] = P(0.0);
    for (int i = 0; i < K::outputs; i++) g[t.out[i]] = g[t.out[i]] + bar[out[i] >= 0 ? out[i] : ~out[i]];
    all_reverse<K>(v, g, Operations<K>{});
    for (int i = 0; i < K::inputs; i++) if (t.varies[i]) bar[in[i]] = bar[in[i]] + g[i];
}

// ---- forward tangents ----------------------------------------------------------------------------------------------

// So many directions at once. Values are computed beside each group of them, and of few directions many would be empty.
constexpr int FEW = 4, MANY = 8;
template <class R, int N>
using Along = Pack<R, N>;

// f(constant) with a number of directions as a constant.
template <class F>
TC_INLINE void at_once(int directions, F f) {
    if (directions == FEW) f(std::integral_constant<int, FEW>{});
    else f(std::integral_constant<int, MANY>{});
}

// So many items have their directions side by side in a pack.
template <class R, int N>
constexpr int BESIDE = LANES<R> / N;

// Each direction gets the number of its item: lanes `first`, first + 1, ... of a pack.
template <class R, int N>
struct Spread {
    typedef std::conditional_t<sizeof(R) == 4, int32_t, int64_t> Index;
    typedef Index Indices __attribute__((vector_size(WIDTH)));
    Indices index;
    explicit Spread(int first) {
        for (int i = 0; i < LANES<R>; i++) index[i] = first + i / N;
    }
    Wide<R> operator()(const Wide<R>& pack) const {
        if constexpr (BESIDE<R, N> == 1) return Wide<R>(typename Wide<R>::Lanes{} + pack.v[index[0]]);
        typename Wide<R>::Lanes out;
#ifdef __clang__  // makes one permutation of these
        for (int i = 0; i < LANES<R>; i++) out[i] = pack.v[index[i]];
#else
        out = __builtin_shuffle(pack.v, index);
#endif
        return Wide<R>(out);
    }
};

// Partials of all lanes at once; then the lanes go through the operations with their directions side by side.
template <class K, int I, class P>
TC_INLINE void partials(const P* v, P* p, P* q) {
    constexpr Node n = traced<K>.tape.node[I];
    if constexpr (traced<K>.varies[I] && n.op != Op::input && n.op != Op::select && !is_linear(n.op)) {
        if constexpr (n.op != Op::mul && n.op != Op::mulc) p[I] = first_partial<K, I>(v);
        if constexpr (n.op == Op::div || n.op == Op::atan2) q[I] = second_partial<K, I>(v);
    }
}

template <class K, int I, class P, class Number>
TC_INLINE void along(const P* v, const P* p, const P* q, Number number, P* t) {
    constexpr Node n = traced<K>.tape.node[I];
    constexpr const Trace& k = traced<K>;
    if constexpr (k.varies[I] && n.op != Op::input) {
        if constexpr (n.op == Op::select) {
            const P a = k.varies[n.a] ? t[n.a] : P(0.0), b = k.varies[n.b] ? t[n.b] : P(0.0);
            t[I] = select(number(v[n.c]), a, b);
        } else if constexpr (n.op == Op::mulc) t[I] = t[n.a] * n.value;
        else if constexpr (n.op == Op::rsubc || n.op == Op::neg) t[I] = -t[n.a];
        else if constexpr (n.op == Op::addc) t[I] = t[n.a];
        else if constexpr (n.b < 0) t[I] = t[n.a] * number(p[I]);
        else if constexpr (n.op == Op::add) {
            if constexpr (k.varies[n.a] && k.varies[n.b]) t[I] = t[n.a] + t[n.b];
            else t[I] = t[k.varies[n.a] ? n.a : n.b];
        } else if constexpr (n.op == Op::sub) {
            if constexpr (k.varies[n.a] && k.varies[n.b]) t[I] = t[n.a] - t[n.b];
            else if constexpr (k.varies[n.a]) t[I] = t[n.a];
            else t[I] = -t[n.b];
        } else {
            constexpr bool product = n.op == Op::mul;
            if constexpr (k.varies[n.a] && k.varies[n.b])
                t[I] = t[n.a] * number(product ? v[n.b] : p[I]) + t[n.b] * number(product ? v[n.a] : q[I]);
            else if constexpr (k.varies[n.a]) t[I] = t[n.a] * number(product ? v[n.b] : p[I]);
            else t[I] = t[n.b] * number(product ? v[n.a] : q[I]);
        }
    }
}

template <class K, class P, int... I>
TC_INLINE void all_partials(const P* v, P* p, P* q, std::integer_sequence<int, I...>) { (partials<K, I>(v, p, q), ...); }
template <class K, class P, class Number, int... I>
TC_INLINE void all_along(const P* v, const P* p, const P* q, Number number, P* t, std::integer_sequence<int, I...>) {
    (along<K, I>(v, p, q, number, t), ...);
}

template <class K, class R, int N>
void tangent(Wide<R>* regs, Along<R, N>* dots, const int* in, const int* out) {
    using P = Wide<R>;
    constexpr const Trace& k = traced<K>;
    constexpr int L = LANES<R>;
    P v[k.tape.size], p[k.tape.size], q[k.tape.size];
    for (int i = 0; i < K::inputs; i++) v[i] = regs[in[i]];
    all_forward<K>(v, Operations<K>{});
    all_partials<K>(v, p, q, Operations<K>{});
    auto place = [&](int reg, int lane) -> P& { return *reinterpret_cast<P*>(dots + reg * L + lane); };
    for (int lane = 0; lane < L; lane += BESIDE<R, N>) {
        P t[k.tape.size];
        for (int i = 0; i < K::inputs; i++) if (k.varies[i]) t[i] = place(in[i], lane);
        all_along<K>(v, p, q, Spread<R, N>(lane), t, Operations<K>{});
        for (int i = 0; i < K::outputs; i++) {
            const P result = k.varies[k.out[i]] ? t[k.out[i]] : P(0.0);
            P& there = place(out[i] >= 0 ? out[i] : ~out[i], lane);
            there = out[i] >= 0 ? result : there + result;
        }
    }
    for (int i = 0; i < K::outputs; i++)
        if (out[i] >= 0) regs[out[i]] = v[k.out[i]];
        else regs[~out[i]] = regs[~out[i]] + v[k.out[i]];
}

// ---- what the machine calls ----------------------------------------------------------------------------------------

// A kernel's operations as plain numbers, for what compiles them otherwise: engine/cuda.
struct Listing {
    const Node* nodes;
    const bool* varies;
    const int* out;
    int size;
};
template <class K>
struct Compact {  // the trace without its empty rest
    static constexpr int size = traced<K>.tape.size;
    Node nodes[size]{};
    bool varies[size]{};
    int out[K::outputs]{};
    constexpr Compact() {
        for (int i = 0; i < size; i++) nodes[i] = traced<K>.tape.node[i], varies[i] = traced<K>.varies[i];
        for (int i = 0; i < K::outputs; i++) out[i] = traced<K>.out[i];
    }
};
template <class K>
inline constexpr Compact<K> compact{};

template <class R>
struct Kernel {
    const char* name;
    int inputs, outputs, flops;
    Listing listing;
    void (*value)(Wide<R>*, const int*, const int*);
    void (*adjoint)(const Wide<R>*, Wide<R>*, const int*, const int*);
    void (*few)(Wide<R>*, Along<R, FEW>*, const int*, const int*);
    void (*many)(Wide<R>*, Along<R, MANY>*, const int*, const int*);
    void tangent(Wide<R>* regs, Along<R, FEW>* dots, const int* in, const int* out) const { few(regs, dots, in, out); }
    void tangent(Wide<R>* regs, Along<R, MANY>* dots, const int* in, const int* out) const { many(regs, dots, in, out); }
};

template <class K, class R>
constexpr Kernel<R> kernel() {
    constexpr const Compact<K>& c = compact<K>;
    return {K::name, K::inputs, K::outputs, traced<K>.flops, {c.nodes, c.varies, c.out, c.size}, value<K, R>, adjoint<K, R>, tangent<K, R, FEW>, tangent<K, R, MANY>};
}

}  // namespace tc
