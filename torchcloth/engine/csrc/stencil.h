// Linear operators whose rows are stencils of vertices: derivatives on the mesh, and the plate matrix.
#pragma once

#include <algorithm>

#include "stencil_lanes.h"

namespace tc {

// Adds sum_n W_c(n, v) (X(neighbour(n, v)) - X(v)) to Y_c(v). The transposed form adds minus the transpose of Y to X.
// The symmetric form is plain, and equal to its transpose. The weights lie as [count, N, V]; weights that are a
// parameter get a gradient.
template <class R>
struct Stencil : Stage<R> {
    const Program<R>& program;
    std::vector<int> others;           // vertices, laid out like the weights
    std::vector<int> used_neighbours;  // by group; the remaining entries are the vertices themselves
    int weight;                        // field
    int x, y;                          // fields of 3, and 3 count, components
    int vertices, neighbours, groups, count;
    StencilForm form;

    Stencil(const Program<R>& p, int table, int weight, int x, int y, StencilForm form)
        : program(p),
          weight(weight),
          x(x),
          y(y),
          vertices(p.fields[weight].vertices),
          neighbours(p.fields[weight].neighbours),
          groups(p.fields[weight].groups()),
          count(p.fields[weight].rows / neighbours / vertices),
          form(form) {
        others.assign(size_t(groups) * neighbours * 4, 0);
        for (int n = 0; n < neighbours; n++)
            for (int v = 0; v < vertices; v++) others[at(0, v, n)] = p.tables[table][size_t(n) * vertices + v];
        used_neighbours.assign(groups, 0);
        for (int v = 0; v < vertices; v++)
            for (int n = used_neighbours[v / 4]; n < neighbours; n++)
                if (other(v, n) != v) used_neighbours[v / 4] = n + 1;
    }

    void forward(Scene<R>& s) const override {
        if (s.lanes > 1) return lanes(s).forward();
        if (form == StencilForm::transposed) apply_transpose<1>(s.value[weight], s.value[y], s.value[x], R(1));
        else apply<1>(s, s.value[weight], s.value[x], s.value[y], R(1));
    }
    void reverse(Scene<R>& s) const override {
        if (s.lanes > 1) return lanes(s).reverse();
        if (form == StencilForm::transposed) {
            apply<1>(s, s.value[weight], s.bar[x], s.bar[y], R(-1));
            if (s.bar[weight]) weight_gradient(s, s.bar[x], s.value[y], s.bar[weight], R(-1));
        } else {
            if (form == StencilForm::symmetric) apply<1>(s, s.value[weight], s.bar[y], s.bar[x], R(1));
            else apply_transpose<1>(s.value[weight], s.bar[y], s.bar[x], R(-1));
            if (s.bar[weight]) weight_gradient(s, s.value[x], s.bar[y], s.bar[weight], R(1));
        }
    }
    void tangent(Scene<R>& s) const override {
        forward(s);
        with_direction_count(s.directions, [&](auto n) {
            using D = DirectionPack<R, n>;
            if (form == StencilForm::transposed) apply_transpose<n>(s.value[weight], s.dot[y], s.dot[x], R(1));
            else apply<n>(s, s.value[weight], s.dot[x], s.dot[y], R(1));
            if (s.dot[weight] == nullptr) return;
            if (form == StencilForm::transposed) apply_transpose_weight_tangents<D>(s);
            else apply_weight_tangents<D>(s);
        });
    }

  private:
    StencilLanes<R> lanes(Scene<R>& s) const {
        return {s, program.fields[weight], others.data(), used_neighbours.data(), weight, x, y,
                program.fields[y].pitch, form};
    }
    size_t at(int c, int v, int n) const { return ((size_t(c) * groups + v / 4) * neighbours + n) * 4 + v % 4; }
    int other(int v, int n) const { return others[at(0, v, n)]; }
    size_t pitch() const { return program.fields[y].pitch; }  // x has 4
    // A vector with K numbers for each component, and room for a fourth component, as packs of the processor's width.
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
    const Row<K>& vector(const R* field, int v) const {
        return *reinterpret_cast<const Row<K>*>(field + size_t(v) * 4 * K);
    }
    template <int K>
    Row<K>& vector(R* field, int v) const { return *reinterpret_cast<Row<K>*>(field + size_t(v) * 4 * K); }
    const Quad<R>& quad(const R* field, int v) const {
        return *reinterpret_cast<const Quad<R>*>(field + size_t(v) * 4);
    }
    template <int K>
    Row<K> scaled_row(const R* field, int c, int v, R sign) const {
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
    void apply(const Scene<R>& s, const R* w, const R* from, R* to, R sign) const {
        over_vertices(s, [&](int c, int v, int last) {
            if constexpr (K == 1)
                for (; v + 4 <= last; v += 4) apply_to_group(w, from, to, sign, c, v);
            for (; v < last; v++) {
                Row<K> sum, centre = vector<K>(from, v);
                for (int k = 0; k < PACKS<K>; k++) sum.part[k] = Part<K>(0.0);
                for (int n = 0; n < used_neighbours[v / 4]; n++) {
                    const Part<K> weight = all<Part<K>>(w[at(c, v, n)]);
                    const Row<K>& neighbour = vector<K>(from, other(v, n));
                    for (int k = 0; k < PACKS<K>; k++)
                        sum.part[k] = sum.part[k] + weight * (neighbour.part[k] - centre.part[k]);
                }
                add<K>(to, c, v, sum, sign);
            }
        });
    }
    // Calls f(component, first vertex, behind the last one) for whole groups, on the thread that has these rows.
    template <class F>
    void over_vertices(const Scene<R>& s, F f) const {
        over_rows(s, groups, [&](int first, int last) {
            for (int c = 0; c < count; c++) f(c, 4 * first, std::min(4 * last, vertices));
        });
    }
    // Four vertices at a time: a single vertex would wait for its sum at every neighbour.
    void apply_to_group(const R* w, const R* from, R* to, R sign, int c, int v) const {
        Row<1> centre[4], sum[4];
        for (int i = 0; i < 4; i++) centre[i] = vector<1>(from, v + i), sum[i].part[0] = Quad<R>(0.0);
        const R* weights = w + at(c, v, 0);
        const int* index = others.data() + at(0, v, 0);
        for (int n = 0; n < used_neighbours[v / 4]; n++)
            for (int i = 0; i < 4; i++) {
                const Quad<R> step = quad(from, index[4 * n + i]) - centre[i].part[0];
                sum[i].part[0] = sum[i].part[0] + all<Quad<R>>(weights[4 * n + i]) * step;
            }
        if (pitch() == 4)  // the vector fills its row, whose fourth number stays zero
            for (int i = 0; i < 4; i++) {
                Part<1>& row = vector<1>(to, v + i).part[0];
                row = row + all<Part<1>>(sign) * sum[i].part[0];
            }
        else for (int i = 0; i < 4; i++) add<1>(to, c, v + i, sum[i], sign);
    }

    template <int K>
    void apply_transpose(const R* w, const R* from, R* to, R sign) const {
        for (int c = 0; c < count; c++)
            for (int v = 0; v < vertices; v++) {
                const Row<K> moment = scaled_row<K>(from, c, v, sign);
                Row<K> centre{};
                for (int n = 0; n < used_neighbours[v / 4]; n++) {
                    const Part<K> weight = all<Part<K>>(w[at(c, v, n)]);
                    Row<K>& neighbour = vector<K>(to, other(v, n));
                    for (int k = 0; k < PACKS<K>; k++) {
                        const Part<K> share = weight * moment.part[k];
                        centre.part[k] = centre.part[k] + share;
                        neighbour.part[k] = neighbour.part[k] - share;
                    }
                }
                Row<K>& result = vector<K>(to, v);
                for (int k = 0; k < PACKS<K>; k++) result.part[k] = result.part[k] + centre.part[k];
            }
    }

    // Adds the work of the differences of X on Y per unit of each weight; the weights of a group lie next to each
    // other.
    void weight_gradient(const Scene<R>& s, const R* from, const R* on, R* to, R sign) const {
        over_vertices(s, [&](int c, int v, int last) {
            for (; v < last; v += 4) {
                Quad<R> centre[4], moment[4];
                for (int i = 0; i < 4; i++) {
                    centre[i] = quad(from, std::min(v + i, vertices - 1));
                    moment[i] = v + i < vertices ? scaled_row<1>(on, c, v + i, sign).part[0] : Quad<R>(0.0);
                }
                for (int n = 0; n < used_neighbours[v / 4]; n++) {
                    const int* index = others.data() + at(0, v, n);
                    Quad<R> work[4];
                    for (int i = 0; i < 4; i++) work[i] = (quad(from, index[i]) - centre[i]) * moment[i];
                    Quad<R>& target = *reinterpret_cast<Quad<R>*>(to + at(c, v, n));
                    target = target + sums(work);
                }
            }
        });
    }
    static Quad<R> sums(const Quad<R>* a) {  // the sum of each quad's numbers
        const auto ab =
            __builtin_shufflevector(a[0].v, a[1].v, 0, 4, 2, 6) + __builtin_shufflevector(a[0].v, a[1].v, 1, 5, 3, 7);
        const auto cd =
            __builtin_shufflevector(a[2].v, a[3].v, 0, 4, 2, 6) + __builtin_shufflevector(a[2].v, a[3].v, 1, 5, 3, 7);
        return Quad<R>(__builtin_shufflevector(ab, cd, 0, 1, 4, 5) + __builtin_shufflevector(ab, cd, 2, 3, 6, 7));
    }
    template <class D>
    void apply_weight_tangents(Scene<R>& s) const {
        const R* from = s.value[x];
        const D* weight_tangent = reinterpret_cast<const D*>(s.dot[weight]);
        each_weight([&](size_t at, int c, int v, int other) {
            const Quad<R> d = quad(from, other) - quad(from, v);
            D* to = reinterpret_cast<D*>(s.dot[y]) + v * pitch() + 3 * c;
            for (int k = 0; k < 3; k++) to[k] = to[k] + weight_tangent[at] * all<D>(d.v[k]);
        });
    }
    template <class D>
    void apply_transpose_weight_tangents(Scene<R>& s) const {
        const D* weight_tangent = reinterpret_cast<const D*>(s.dot[weight]);
        D* to = reinterpret_cast<D*>(s.dot[x]);
        each_weight([&](size_t at, int c, int v, int other) {
            const Quad<R> row = scaled_row<1>(s.value[y], c, v, R(1)).part[0];
            for (int k = 0; k < 3; k++) {
                const D share = weight_tangent[at] * all<D>(row.v[k]);
                to[v * 4 + k] = to[v * 4 + k] + share;
                to[other * 4 + k] = to[other * 4 + k] - share;
            }
        });
    }
    template <class F>
    void each_weight(F work) const {
        for (int c = 0; c < count; c++)
            for (int v = 0; v < vertices; v++)
                for (int n = 0; n < used_neighbours[v / 4]; n++) work(at(c, v, n), c, v, other(v, n));
    }
};

}  // namespace tc
