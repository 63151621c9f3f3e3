// A Stencil on scenes in the lanes of packs: every number of a field is a pack of scenes.
#pragma once

#include "program.h"

namespace tc {

template <class R>
struct StencilLanes {
    using P = Wide<R>;

    const Scene<R>& s;
    const Field& weights;
    const int *others, *used_neighbours;  // as in Stencil
    int weight, x, y;                     // fields
    int pitch;                            // of y; x has 4
    StencilForm form;

    void forward() const {
        if (form == StencilForm::transposed) apply_transpose(packs(s.value[y]), packs(s.value[x]), 1.0);
        else apply(packs(s.value[x]), packs(s.value[y]), 1.0);
    }
    void reverse() const {
        P *bar_x = packs(s.bar[x]), *bar_y = packs(s.bar[y]);
        if (form == StencilForm::transposed) apply(bar_x, bar_y, -1.0);
        else if (form == StencilForm::symmetric) apply(bar_y, bar_x, 1.0);
        else apply_transpose(bar_y, bar_x, -1.0);
        if (!s.bar[weight]) return;
        if (form == StencilForm::transposed) weight_gradient(bar_x, packs(s.value[y]), -1.0);
        else weight_gradient(packs(s.value[x]), bar_y, 1.0);
    }

  private:
    static P* packs(R* field) { return reinterpret_cast<P*>(field); }
    int count() const { return weights.rows / weights.neighbours / weights.vertices; }
    // Place of a weight; `others` lies like the weights of the first component.
    size_t place(int c, int v, int n) const {
        return ((size_t(c) * weights.groups() + v / 4) * weights.neighbours + n) * 4 + v % 4;
    }
    size_t row(int c, int v) const { return size_t(v) * pitch + 3 * c; }
    P weight_at(size_t at) const {
        R* w = s.value[weight];
        return weights.kind == FieldKind::constant ? P(w[at]) : packs(w)[at];
    }
    // Calls f(place of the weight, neighbour) for the weights of a vertex.
    template <class F>
    void for_each_weight(int c, int v, F f) const {
        for (int n = 0; n < used_neighbours[v / 4]; n++) f(place(c, v, n), others[place(0, v, n)]);
    }

    void apply(const P* from, P* to, double sign) const {
        over_rows(s, weights.vertices, [&](int first, int last) {
            for (int c = 0; c < count(); c++)
                for (int v = first; v < last; v++) {
                    P sum[3] = {P(0.0), P(0.0), P(0.0)};
                    for_each_weight(c, v, [&](size_t at, int other) {
                        const P w = weight_at(at);
                        for (int k = 0; k < 3; k++) sum[k] = sum[k] + w * (from[other * 4 + k] - from[v * 4 + k]);
                    });
                    for (int k = 0; k < 3; k++) to[row(c, v) + k] = to[row(c, v) + k] + sign * sum[k];
                }
        });
    }
    void apply_transpose(const P* from, P* to, double sign) const {
        for (int c = 0; c < count(); c++)
            for (int v = 0; v < weights.vertices; v++)
                for_each_weight(c, v, [&](size_t at, int other) {
                    const P w = sign * weight_at(at);
                    for (int k = 0; k < 3; k++) {
                        const P share = w * from[row(c, v) + k];
                        to[v * 4 + k] = to[v * 4 + k] + share, to[other * 4 + k] = to[other * 4 + k] - share;
                    }
                });
    }
    // Adds the work of the differences of X on Y per unit of each weight.
    void weight_gradient(const P* from, const P* on, double sign) const {
        P* to = packs(s.bar[weight]);
        for (int c = 0; c < count(); c++)
            for (int v = 0; v < weights.vertices; v++)
                for_each_weight(c, v, [&](size_t at, int other) {
                    for (int k = 0; k < 3; k++)
                        to[at] = to[at] + sign * ((from[other * 4 + k] - from[v * 4 + k]) * on[row(c, v) + k]);
                });
    }
};

}  // namespace tc
