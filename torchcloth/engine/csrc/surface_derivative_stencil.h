// The five derivatives of a field of vectors at every vertex, and the transpose of this operator: a Stencil with
// constant weights, five at a time. Both directions gather, so that no addition waits for an earlier store.
#pragma once

#include <array>
#include <utility>

#include "stencil.h"

namespace tc {

// A sparse matrix by rows (CSR): the neighbours of each vertex, with eight numbers each: five weights and three zeros.
template <class R>
struct CsrLinks {
    std::vector<int> first, other;
    Buffer<R> weight;

    using Rows = std::vector<std::vector<std::pair<int, std::array<double, 5>>>>;

    explicit CsrLinks(const Rows& rows) : first{0} {
        for (const auto& row : rows) {
            for (const auto& link : row) other.push_back(link.first);
            first.push_back(int(other.size()));
        }
        weight.reset(8 * other.size());
        size_t at = 0;
        for (const auto& row : rows)
            for (const auto& link : row) {
                for (int c = 0; c < 5; c++) weight.data[at + c] = R(link.second[c]);
                at += 8;
            }
    }
};

template <class R>
struct StencilAndTranspose {
    std::unique_ptr<CsrLinks<R>> forward, transpose;

    StencilAndTranspose(const Program<R>& p, int table, int weight) {
        const Field& f = p.fields[weight];
        typename CsrLinks<R>::Rows to(f.vertices), from(f.vertices);
        for (int v = 0; v < f.vertices; v++) {
            std::array<double, 5> sum{};
            for (int n = 0; n < f.neighbours; n++) {
                const int other = p.tables[table][size_t(n) * f.vertices + v];
                if (other == v) continue;  // rows are filled up with the vertex itself
                std::array<double, 5> w, minus;
                for (int c = 0; c < 5; c++) {
                    w[c] = p.constants[weight].data[f.place((size_t(c) * f.neighbours + n) * f.vertices + v)];
                    sum[c] += w[c], minus[c] = -w[c];
                }
                to[v].push_back({other, w}), from[other].push_back({v, minus});
            }
            from[v].push_back({v, sum});
        }
        forward = std::make_unique<CsrLinks<R>>(to), transpose = std::make_unique<CsrLinks<R>>(from);
    }
};

template <class R>
struct SurfaceDerivatives : Stage<R> {
    using Row = Pack<R, 16>;  // five vectors and a zero
    const Program<R>& program;
    std::shared_ptr<const StencilAndTranspose<R>> links;
    int weight, x, y;  // y has 15 components
    bool transposed;

    SurfaceDerivatives(const Program<R>& p, std::shared_ptr<const StencilAndTranspose<R>> links, int weight, int x,
                       int y, bool transposed)
        : program(p), links(std::move(links)), weight(weight), x(x), y(y), transposed(transposed) {}

    static bool fits(const Program<R>& p, int weight, int y) {
        return p.fields[weight].kind == FieldKind::constant && p.fields[y].comps == 15;
    }

    void forward(Scene<R>& s) const override {
        if (s.lanes > 1) return apply_either<Wide<R>>(s, s.value[x], s.value[y], transposed, R(1));
        if (transposed) apply_transpose(s, s.value[y], s.value[x], R(1));
        else apply(s, s.value[x], s.value[y], R(1));
    }
    void reverse(Scene<R>& s) const override {
        if (s.lanes > 1) return apply_either<Wide<R>>(s, s.bar[x], s.bar[y], !transposed, R(-1));
        if (transposed) apply(s, s.bar[x], s.bar[y], R(-1));
        else apply_transpose(s, s.bar[y], s.bar[x], R(-1));
    }
    void tangent(Scene<R>& s) const override {
        forward(s);
        with_direction_count(s.directions, [&](auto n) {
            apply_either<DirectionPack<R, n>>(s, s.dot[x], s.dot[y], transposed, R(1));
        });
    }

  private:
    int vertices() const { return program.fields[x].rows; }
    const Quad<R>& vector(const R* field, int v) const {
        return *reinterpret_cast<const Quad<R>*>(field + size_t(v) * 4);
    }
    Quad<R>& vector(R* field, int v) const { return *reinterpret_cast<Quad<R>*>(field + size_t(v) * 4); }
    const Row& row(const R* field, int v) const { return *reinterpret_cast<const Row*>(field + size_t(v) * 16); }
    Row& row(R* field, int v) const { return *reinterpret_cast<Row*>(field + size_t(v) * 16); }
    static Row five_times(Quad<R> a) {  // in two steps, because a widening shuffle would go through memory
        const auto b = __builtin_shufflevector(a.v, a.v, 0, 1, 2, 3, 4, 5, 6, 7);
        if constexpr (HALVED<R, 16>)
            return {Wide<R>(__builtin_shufflevector(b, b, 0, 1, 2, 0, 1, 2, 0, 1)),
                    Wide<R>(__builtin_shufflevector(b, b, 2, 0, 1, 2, 0, 1, 2, 3))};
        else {
            const auto c = __builtin_shufflevector(b, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            return Row(__builtin_shufflevector(c, c, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 3));
        }
    }
    static Row weights(const R* w) {
        const auto a = reinterpret_cast<const Pack<R, 8>*>(w)->v;
        if constexpr (HALVED<R, 16>)
            return {Wide<R>(__builtin_shufflevector(a, a, 0, 0, 0, 1, 1, 1, 2, 2)),
                    Wide<R>(__builtin_shufflevector(a, a, 2, 3, 3, 3, 4, 4, 4, 5))};
        else {
            const auto b = __builtin_shufflevector(a, a, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            return Row(__builtin_shufflevector(b, b, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5));
        }
    }
    static Quad<R> summed(Row a) {  // of the five vectors
        const typename Quad<R>::Lanes none{};
        if constexpr (HALVED<R, 16>) {
            const auto l = a.low.v, h = a.high.v;
            const auto sum = __builtin_shufflevector(l, h, 0, 1, 2, 15) + __builtin_shufflevector(l, h, 3, 4, 5, 15) +
                             __builtin_shufflevector(l, h, 6, 7, 8, 15) + __builtin_shufflevector(l, h, 9, 10, 11, 15) +
                             __builtin_shufflevector(l, h, 12, 13, 14, 15);
            return Quad<R>(__builtin_shufflevector(sum, none, 0, 1, 2, 4));
        } else {
            const auto b =
                a.v + __builtin_shufflevector(a.v, a.v, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2);
            const auto c = b + __builtin_shufflevector(b, b, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5);
            const auto d = c + __builtin_shufflevector(a.v, a.v, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11);
            return Quad<R>(__builtin_shufflevector(__builtin_shufflevector(d, d, 0, 1, 2, 3), none, 0, 1, 2, 4));
        }
    }

    // Y(v) += sign sum_u w(u) (X(u) - X(v)). Differences are small wherever the sheet lies, so they round little.
    void apply(const Scene<R>& s, const R* from, R* to, R sign) const {
        const CsrLinks<R>& l = *links->forward;
        over_rows(s, vertices(), [&](int begin, int end) {
            for (int v = begin; v < end; v++) {
                const Quad<R> centre = vector(from, v);
                Row sum(0.0);
                for (int k = l.first[v]; k < l.first[v + 1]; k++)
                    sum = sum + weights(l.weight.data + 8 * size_t(k)) * five_times(vector(from, l.other[k]) - centre);
                row(to, v) = row(to, v) + double(sign) * sum;
            }
        });
    }
    // X(v) -= sign times the transpose of this operator applied to Y.
    void apply_transpose(const Scene<R>& s, const R* from, R* to, R sign) const {
        const CsrLinks<R>& l = *links->transpose;
        over_rows(s, vertices(), [&](int begin, int end) {
            for (int v = begin; v < end; v++) {
                Row sum(0.0);
                for (int k = l.first[v]; k < l.first[v + 1]; k++)
                    sum = sum + weights(l.weight.data + 8 * size_t(k)) * row(from, l.other[k]);
                vector(to, v) = vector(to, v) + Quad<R>(typename Quad<R>::Lanes{} + sign) * summed(sum);
            }
        });
    }

    // Applies the operator or its transpose to fields whose numbers are packs D, of scenes or of directions.
    template <class D>
    void apply_either(const Scene<R>& s, R* field_x, R* field_y, bool transpose, R sign) const {
        D *x = reinterpret_cast<D*>(field_x), *y = reinterpret_cast<D*>(field_y);
        if (transpose) apply_transpose_to_packs(s, y, x, sign);
        else apply_to_packs(s, x, y, sign);
    }
    template <class D>
    void apply_to_packs(const Scene<R>& s, const D* from, D* to, R sign) const {
        const CsrLinks<R>& l = *links->forward;
        over_rows(s, vertices(), [&](int begin, int end) {
            for (int v = begin; v < end; v++) {
                D sum[15];  // stays in registers until the vertex is done
                for (D& part : sum) part = D(0.0);
                for (int k = l.first[v]; k < l.first[v + 1]; k++) {
                    const R* w = l.weight.data + 8 * size_t(k);
                    for (int i = 0; i < 3; i++) {
                        const D d = from[l.other[k] * 4 + i] - from[v * 4 + i];
                        for (int c = 0; c < 5; c++) sum[3 * c + i] = sum[3 * c + i] + d * w[c];
                    }
                }
                D* target = to + size_t(v) * 16;
                for (int c = 0; c < 15; c++) target[c] = target[c] + double(sign) * sum[c];
            }
        });
    }
    template <class D>
    void apply_transpose_to_packs(const Scene<R>& s, const D* from, D* to, R sign) const {
        const CsrLinks<R>& l = *links->transpose;
        over_rows(s, vertices(), [&](int begin, int end) {
            for (int v = begin; v < end; v++) {
                D sum[3] = {D(0.0), D(0.0), D(0.0)};
                for (int k = l.first[v]; k < l.first[v + 1]; k++) {
                    const R* w = l.weight.data + 8 * size_t(k);
                    const D* row_of_neighbour = from + size_t(l.other[k]) * 16;
                    for (int c = 0; c < 5; c++)
                        for (int i = 0; i < 3; i++) sum[i] = sum[i] + row_of_neighbour[3 * c + i] * w[c];
                }
                D* target = to + size_t(v) * 4;
                for (int i = 0; i < 3; i++) target[i] = target[i] + double(sign) * sum[i];
            }
        });
    }
};

}  // namespace tc
