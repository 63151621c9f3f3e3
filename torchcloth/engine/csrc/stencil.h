// Linear operators whose rows are stencils of vertices: derivatives on the mesh, and the plate matrix.
#pragma once

#include <algorithm>

#include "program.h"

namespace tc {

enum class Shape : int { plain, transposed, symmetric };

// Y_c(v) = sum_n W_c(n, v) (X(near(n, v)) - X(v)), added to Y; transposed: minus its transpose, from Y to X; symmetric:
// plain, and its own transpose. The weights lie as [count, N, V]; a parameter among them gets its derivative.
template <class R>
struct Stencil : Stage<R> {
    const Program<R>& program;
    std::vector<int> others;  // vertices, laid out like the weights
    std::vector<int> used;    // of these, by group: the rest are the vertices themselves
    int weight;               // field
    int x, y;                 // fields of 3, and 3 count, components
    int vertices, near, groups, count;
    Shape shape;

    Stencil(const Program<R>& p, int table, int weight, int x, int y, Shape shape)
        : program(p), weight(weight), x(x), y(y), vertices(p.fields[weight].vertices), near(p.fields[weight].near),
          groups(p.fields[weight].groups()), count(p.fields[weight].rows / near / vertices), shape(shape) {
        others.assign(size_t(groups) * near * 4, 0);
        for (int n = 0; n < near; n++)
            for (int v = 0; v < vertices; v++) others[at(0, v, n)] = p.tables[table][size_t(n) * vertices + v];
        used.assign(groups, 0);
        for (int v = 0; v < vertices; v++)
            for (int n = used[v / 4]; n < near; n++)
                if (other(v, n) != v) used[v / 4] = n + 1;
    }

    void forward(Scene<R>& s) const override {
        if (shape == Shape::transposed) spread<1>(s.value[weight], s.value[y], s.value[x], R(1));
        else differences<1>(s, s.value[weight], s.value[x], s.value[y], R(1));
    }
    void reverse(Scene<R>& s) const override {
        if (shape == Shape::transposed) {
            differences<1>(s, s.value[weight], s.bar[x], s.bar[y], R(-1));
            if (s.bar[weight]) weigh(s, s.bar[x], s.value[y], s.bar[weight], R(-1));
        } else {
            if (shape == Shape::symmetric) differences<1>(s, s.value[weight], s.bar[y], s.bar[x], R(1));
            else spread<1>(s.value[weight], s.bar[y], s.bar[x], R(-1));
            if (s.bar[weight]) weigh(s, s.value[x], s.bar[y], s.bar[weight], R(1));
        }
    }
    void tangent(Scene<R>& s) const override {
        forward(s);
        at_once(s.directions, [&](auto n) {
            using D = Along<R, n>;
            if (shape == Shape::transposed) spread<n>(s.value[weight], s.dot[y], s.dot[x], R(1));
            else differences<n>(s, s.value[weight], s.dot[x], s.dot[y], R(1));
            if (s.dot[weight] == nullptr) return;
            if (shape == Shape::transposed) spread_weights<D>(s);
            else difference_weights<D>(s);
        });
    }

  private:
    size_t at(int c, int v, int n) const { return ((size_t(c) * groups + v / 4) * near + n) * 4 + v % 4; }
    int other(int v, int n) const { return others[at(0, v, n)]; }
    size_t pitch() const { return program.fields[y].pitch; }  // x has 4
    // A vector with K numbers for each component, and room for a fourth; as packs that the processor has.
    template <int K>
    using Part = Pack<R, (4 * K < LANES<R> ? 4 * K : LANES<R>)>;
    template <int K>
    static constexpr int PACKS = 4 * K * int(sizeof(R)) / int(sizeof(Part<K>));
    template <int K>
    struct Row {
        Part<K> part[PACKS<K>];
    };
    template <class V>
    static V all(R number) { return V(typename V::Lanes{} + number); }

    template <int K>
    const Row<K>& vector(const R* field, int v) const { return *reinterpret_cast<const Row<K>*>(field + size_t(v) * 4 * K); }
    template <int K>
    Row<K>& vector(R* field, int v) const { return *reinterpret_cast<Row<K>*>(field + size_t(v) * 4 * K); }
    const Quad<R>& quad(const R* field, int v) const { return *reinterpret_cast<const Quad<R>*>(field + size_t(v) * 4); }
    template <int K>
    Row<K> given(const R* field, int c, int v, R sign) const {
        Row<K> out{};
        std::memcpy(&out, field + (v * pitch() + 3 * c) * K, 3 * K * sizeof(R));
        for (Part<K>& part : out.part) part = all<Part<K>>(sign) * part;
        return out;
    }
    template <int K>
    void add(R* field, int c, int v, const Row<K>& value, R sign) const {
        R numbers[4 * K], *to = field + (v * pitch() + 3 * c) * K;
        std::memcpy(numbers, &value, sizeof(value));
        for (int k = 0; k < 3 * K; k++) to[k] += sign * numbers[k];
    }

    template <int K>
    void differences(const Scene<R>& s, const R* w, const R* from, R* to, R sign) const {
        over_vertices(s, [&](int c, int v, int last) {
            if constexpr (K == 1)
                for (; v + 4 <= last; v += 4) together(w, from, to, sign, c, v);
            for (; v < last; v++) {
                Row<K> sum, own = vector<K>(from, v);
                for (int k = 0; k < PACKS<K>; k++) sum.part[k] = Part<K>(0.0);
                for (int n = 0; n < used[v / 4]; n++) {
                    const Part<K> weight = all<Part<K>>(w[at(c, v, n)]);
                    const Row<K>& there = vector<K>(from, other(v, n));
                    for (int k = 0; k < PACKS<K>; k++) sum.part[k] = sum.part[k] + weight * (there.part[k] - own.part[k]);
                }
                add<K>(to, c, v, sum, sign);
            }
        });
    }
    // f(component, first vertex, behind the last one): whole groups, by the thread that has these rows.
    template <class F>
    void over_vertices(const Scene<R>& s, F f) const {
        over_rows(s, groups, [&](int first, int last) {
            for (int c = 0; c < count; c++) f(c, 4 * first, std::min(4 * last, vertices));
        });
    }
    // A group side by side: one vertex alone waits for its sum at every neighbour.
    void together(const R* w, const R* from, R* to, R sign, int c, int v) const {
        Row<1> own[4], sum[4];
        for (int i = 0; i < 4; i++) own[i] = vector<1>(from, v + i), sum[i].part[0] = Quad<R>(0.0);
        const R* weights = w + at(c, v, 0);
        const int* index = others.data() + at(0, v, 0);
        for (int n = 0; n < used[v / 4]; n++)
            for (int i = 0; i < 4; i++) {
                const Quad<R> step = quad(from, index[4 * n + i]) - own[i].part[0];
                sum[i].part[0] = sum[i].part[0] + all<Quad<R>>(weights[4 * n + i]) * step;
            }
        if (pitch() == 4)  // alone in its row, whose fourth number stays zero
            for (int i = 0; i < 4; i++) {
                Part<1>& row = vector<1>(to, v + i).part[0];
                row = row + all<Part<1>>(sign) * sum[i].part[0];
            }
        else for (int i = 0; i < 4; i++) add<1>(to, c, v + i, sum[i], sign);
    }

    template <int K>
    void spread(const R* w, const R* from, R* to, R sign) const {
        for (int c = 0; c < count; c++)
            for (int v = 0; v < vertices; v++) {
                const Row<K> moment = given<K>(from, c, v, sign);
                Row<K> own{};
                for (int n = 0; n < used[v / 4]; n++) {
                    const Part<K> weight = all<Part<K>>(w[at(c, v, n)]);
                    Row<K>& there = vector<K>(to, other(v, n));
                    for (int k = 0; k < PACKS<K>; k++) {
                        const Part<K> share = weight * moment.part[k];
                        own.part[k] = own.part[k] + share;
                        there.part[k] = there.part[k] - share;
                    }
                }
                Row<K>& here = vector<K>(to, v);
                for (int k = 0; k < PACKS<K>; k++) here.part[k] = here.part[k] + own.part[k];
            }
    }

    // Work that the differences of X do on Y, per unit of each weight; the weights of a group lie side by side.
    void weigh(const Scene<R>& s, const R* from, const R* on, R* to, R sign) const {
        over_vertices(s, [&](int c, int v, int last) {
            for (; v < last; v += 4) {
                Quad<R> own[4], moment[4];
                for (int i = 0; i < 4; i++) {
                    own[i] = quad(from, std::min(v + i, vertices - 1));
                    moment[i] = v + i < vertices ? given<1>(on, c, v + i, sign).part[0] : Quad<R>(0.0);
                }
                for (int n = 0; n < used[v / 4]; n++) {
                    const int* index = others.data() + at(0, v, n);
                    Quad<R> work[4];
                    for (int i = 0; i < 4; i++) work[i] = (quad(from, index[i]) - own[i]) * moment[i];
                    Quad<R>& place = *reinterpret_cast<Quad<R>*>(to + at(c, v, n));
                    place = place + sums(work);
                }
            }
        });
    }
    static Quad<R> sums(const Quad<R>* a) {  // of each quad's numbers
        const auto ab = __builtin_shufflevector(a[0].v, a[1].v, 0, 4, 2, 6) + __builtin_shufflevector(a[0].v, a[1].v, 1, 5, 3, 7);
        const auto cd = __builtin_shufflevector(a[2].v, a[3].v, 0, 4, 2, 6) + __builtin_shufflevector(a[2].v, a[3].v, 1, 5, 3, 7);
        return Quad<R>(__builtin_shufflevector(ab, cd, 0, 1, 4, 5) + __builtin_shufflevector(ab, cd, 2, 3, 6, 7));
    }
    template <class D>
    void difference_weights(Scene<R>& s) const {
        const R* from = s.value[x];
        const D* along = reinterpret_cast<const D*>(s.dot[weight]);
        each_weight([&](size_t at, int c, int v, int other) {
            const Quad<R> d = quad(from, other) - quad(from, v);
            D* to = reinterpret_cast<D*>(s.dot[y]) + v * pitch() + 3 * c;
            for (int k = 0; k < 3; k++) to[k] = to[k] + along[at] * all<D>(d.v[k]);
        });
    }
    template <class D>
    void spread_weights(Scene<R>& s) const {
        const D* along = reinterpret_cast<const D*>(s.dot[weight]);
        D* to = reinterpret_cast<D*>(s.dot[x]);
        each_weight([&](size_t at, int c, int v, int other) {
            const Quad<R> whole = given<1>(s.value[y], c, v, R(1)).part[0];
            for (int k = 0; k < 3; k++) {
                const D share = along[at] * all<D>(whole.v[k]);
                to[v * 4 + k] = to[v * 4 + k] + share;
                to[other * 4 + k] = to[other * 4 + k] - share;
            }
        });
    }
    template <class F>
    void each_weight(F work) const {
        for (int c = 0; c < count; c++)
            for (int v = 0; v < vertices; v++)
                for (int n = 0; n < used[v / 4]; n++) work(at(c, v, n), c, v, other(v, n));
    }
};

}  // namespace tc
