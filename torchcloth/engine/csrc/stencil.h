// Linear operators whose rows are stencils of vertices: derivatives on the mesh, and the plate matrix.
#pragma once

#include "program.h"

namespace tc {

// Y_c(v) = sum_n W_c(n, v) (X(near(n, v)) - X(v)), added to Y; transposed: minus its transpose, X from Y.
// The weights lie as [count, N, V]; a parameter among them gets its derivative.
template <class R>
struct Stencil : Stage<R> {
    using D = Along<R>;
    const Program<R>& program;
    int table;   // [N, V]
    int weight;  // raw field
    int x, y;    // fields of 3, and 3 count, components
    int vertices, near, count;
    bool transposed;

    Stencil(const Program<R>& p, int table, int weight, int x, int y, int near, int count, bool transposed)
        : program(p), table(table), weight(weight), x(x), y(y), vertices(p.fields[x].rows), near(near), count(count),
          transposed(transposed) {}

    void forward(Scene<R>& s) const override {
        if (transposed) spread<1>(s.value[weight], s.value[y], s.value[x], R(1));
        else differences<1>(s.value[weight], s.value[x], s.value[y], R(1));
    }
    void reverse(Scene<R>& s) const override {
        if (transposed) {
            differences<1>(s.value[weight], s.bar[x], s.bar[y], R(-1));
            if (s.bar[weight]) weigh(s.bar[x], s.value[y], s.bar[weight], R(-1));
        } else {
            spread<1>(s.value[weight], s.bar[y], s.bar[x], R(-1));
            if (s.bar[weight]) weigh(s.value[x], s.bar[y], s.bar[weight], R(1));
        }
    }
    void tangent(Scene<R>& s) const override {
        forward(s);
        if (transposed) spread<DIRECTIONS>(s.value[weight], s.dot[y], s.dot[x], R(1));
        else differences<DIRECTIONS>(s.value[weight], s.dot[x], s.dot[y], R(1));
        if (s.dot[weight] == nullptr) return;
        if (transposed) spread_weights(s);
        else difference_weights(s);
    }

  private:
    const int* neighbours(int n) const { return program.tables[table].data() + size_t(n) * vertices; }
    size_t stride() const { return program.fields[x].padded; }
    // Fields lie component by component; here the K numbers of the 3 components of a vertex are wanted together.
    template <int K>
    using Row = Pack<R, 4 * K>;

    template <int K>
    Row<K> row(const R* field, int c, int v) const {
        Row<K> out(0.0);
        for (int k = 0; k < 3; k++)
            for (int d = 0; d < K; d++) out.v[k * K + d] = field[((3 * c + k) * stride() + v) * K + d];
        return out;
    }
    template <int K>
    void add(R* field, int c, int v, const Row<K>& value) const {
        for (int k = 0; k < 3; k++)
            for (int d = 0; d < K; d++) field[((3 * c + k) * stride() + v) * K + d] += value.v[k * K + d];
    }
    template <int K>
    void differences(const R* w, const R* from, R* to, R sign) const {
        thread_local std::vector<Row<K>> rows;
        rows.resize(vertices);
        for (int v = 0; v < vertices; v++) rows[v] = row<K>(from, 0, v);
        for (int c = 0; c < count; c++)
            for (int v = 0; v < vertices; v++) {
                Row<K> sum(0.0);
                const Row<K> own = rows[v];
                const R* part = w + size_t(c) * near * vertices + v;
                for (int n = 0; n < near; n++)
                    sum = sum + Row<K>(typename Row<K>::Lanes{} + part[size_t(n) * vertices]) * (rows[neighbours(n)[v]] - own);
                add<K>(to, c, v, Row<K>(typename Row<K>::Lanes{} + sign) * sum);
            }
    }
    template <int K>
    void spread(const R* w, const R* from, R* to, R sign) const {
        thread_local std::vector<Row<K>> rows;
        rows.assign(vertices, Row<K>(0.0));
        for (int c = 0; c < count; c++)
            for (int v = 0; v < vertices; v++) {
                const Row<K> given = Row<K>(typename Row<K>::Lanes{} + sign) * row<K>(from, c, v);
                const R* part = w + size_t(c) * near * vertices + v;
                for (int n = 0; n < near; n++) {
                    const Row<K> share = Row<K>(typename Row<K>::Lanes{} + part[size_t(n) * vertices]) * given;
                    rows[v] = rows[v] + share;
                    Row<K>& other = rows[neighbours(n)[v]];
                    other = other - share;
                }
            }
        for (int v = 0; v < vertices; v++) add<K>(to, 0, v, rows[v]);
    }
    // d(weights): differences of X times Y.
    void weigh(const R* from, const R* times, R* to, R sign) const {
        for (int c = 0; c < count; c++)
            for (int n = 0; n < near; n++)
                for (int v = 0; v < vertices; v++) {
                    R sum = 0;
                    for (int k = 0; k < 3; k++)
                        sum += (from[k * stride() + neighbours(n)[v]] - from[k * stride() + v]) * times[(3 * c + k) * stride() + v];
                    to[(size_t(c) * near + n) * vertices + v] += sign * sum;
                }
    }
    void difference_weights(Scene<R>& s) const {
        const D* w = reinterpret_cast<const D*>(s.dot[weight]);
        D* to = reinterpret_cast<D*>(s.dot[y]);
        const R* from = s.value[x];
        for (int c = 0; c < count; c++)
            for (int n = 0; n < near; n++)
                for (int v = 0; v < vertices; v++)
                    for (int k = 0; k < 3; k++) {
                        const R d = from[k * stride() + neighbours(n)[v]] - from[k * stride() + v];
                        D& place = to[(3 * c + k) * stride() + v];
                        place = place + w[(size_t(c) * near + n) * vertices + v] * D(typename D::Lanes{} + d);
                    }
    }
    void spread_weights(Scene<R>& s) const {
        const D* w = reinterpret_cast<const D*>(s.dot[weight]);
        D* to = reinterpret_cast<D*>(s.dot[x]);
        const R* from = s.value[y];
        for (int c = 0; c < count; c++)
            for (int n = 0; n < near; n++)
                for (int v = 0; v < vertices; v++)
                    for (int k = 0; k < 3; k++) {
                        const D share = w[(size_t(c) * near + n) * vertices + v] * D(typename D::Lanes{} + from[(3 * c + k) * stride() + v]);
                        D &own = to[k * stride() + v], &other = to[k * stride() + neighbours(n)[v]];
                        own = own + share;
                        other = other - share;
                    }
    }
};

}  // namespace tc
