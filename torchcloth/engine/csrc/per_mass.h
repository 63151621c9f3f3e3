// What points gave to the nodes, over the nodes' mass: transfer.push, transfer.velocity_gradient.
#pragma once

#include "contact.h"

namespace tc {

// given: first the two copies of each node (transfer.h) are added up, in place; out = vector of given / mass. For what
// has the mass itself beside the vector, given is the mass; it comes first, and its reverse sweep last.
template <class R>
struct PerMass : Stage<R> {
    using P = Wide<R>;     // of whole nodes
    int mass, given, out;  // fields of nodes
    R least;               // less mass than that has no say, and its square underflows

    PerMass(int mass, int given, int out, R least) : mass(mass), given(given), out(out), least(least) { this->again = true; }

    void forward(Scene<R>& s) const override {
        if (!join(s, s.value[given], 1)) return;
        const P *m = at(s.value[mass]), *from = at(s.value[given]);
        P* to = at(s.value[out]);
        over_blocks(s, [&](int first, int last) {
            for (int i = PACKS * first; i < PACKS * last; i++) to[i] = vectors(from[i] * inverse(m[i]));
        });
    }
    void reverse(Scene<R>& s) const override {
        if (s.layers->points.size() == 0) return;
        const P *m = at(s.value[mass]), *quotient = at(s.value[out]), *seed = at(s.bar[out]);
        P *by_mass = at(s.bar[mass]), *by_given = at(s.bar[given]);
        over_blocks(s, [&](int first, int last) {
            for (int i = PACKS * first; i < PACKS * last; i++) {
                const P g = vectors(seed[i] * inverse(m[i])), work = g * quotient[i];
                by_given[i] = by_given[i] + g;
                by_mass[i] = by_mass[i] - counts(m[i]) * on_masses(work);
            }
        });
        join(s, s.bar[given], 1);
    }
    void tangent(Scene<R>& s) const override {
        forward(s);
        if (!join(s, s.dot[given], s.directions)) return;
        const P *m = at(s.value[mass]), *quotient = at(s.value[out]), *m_dot = at(s.dot[mass]), *from = at(s.dot[given]);
        P* to = at(s.dot[out]);
        over_blocks(s, [&](int first, int last) {
            for (int block = first; block < last; block++)
                for (int p = 0; p < PACKS; p++) {
                    const P own = m[PACKS * block + p], over = inverse(own), each = over * counts(own) * quotient[PACKS * block + p];
                    for (int d = 0; d < s.directions; d++) {
                        const size_t i = size_t(PACKS) * (block * s.directions + d) + p;
                        to[i] = vectors(from[i] * over - masses(m_dot[i]) * each);
                    }
                }
        });
    }

  private:
    static constexpr int PACKS = ON_BLOCK / LANES<R>;
    static P* at(R* field) { return reinterpret_cast<P*>(field); }

    // The last two nodes of a block are the first two of the one above, and threads may have copies of both: all get the
    // sum. False: there are no points.
    static bool join(Scene<R>& s, R* field, int depth) {
        if (s.layers->points.size() == 0) return false;
        const Nodes<R>& nodes = s.layers->nodes;
        over_blocks(s, [&](int first, int last) {
            for (int b = std::max(first, 1); b < last; b++) {
                const int over = nodes.above[b];
                if (over < 0) continue;
                if (nodes.twin[b] == 0 && (over == 0 || nodes.twin[over] == 0)) {
                    if (over == 0) continue;
                    for (int k = 0; k < depth; k++) {
                        Half &upper = half(field, b, 1, k, depth), &lower = half(field, over, 0, k, depth);
                        upper = lower = upper + lower;
                    }
                    continue;
                }
                join_copies(nodes, field, depth, b, over);
                if (nodes.lowermost[b]) join_copies(nodes, field, depth, 0, b);
            }
        });
        return true;
    }
    using Half = Pack<R, ON_BLOCK / 2>;
    static Half& half(R* field, int block, int which, int k, int depth) {
        return *reinterpret_cast<Half*>(field + (size_t(block) * depth + k) * ON_BLOCK + which * (ON_BLOCK / 2));
    }
    // Upper halves of the copies of one block, and lower halves of those of another; 0: none.
    static void join_copies(const Nodes<R>& nodes, R* field, int depth, int below, int over) {
        for (int k = 0; k < depth; k++) {
            Half sum(0.0);
            auto each = [&](auto f) {
                if (below) nodes.copies(below, [&](int b) { f(half(field, b, 1, k, depth)); });
                if (over) nodes.copies(over, [&](int b) { f(half(field, b, 0, k, depth)); });
            };
            each([&](Half& numbers) { sum = sum + numbers; });
            each([&](Half& numbers) { numbers = sum; });
        }
    }
    static P masses(P a) {
        if constexpr (PACKS == 2) return P(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 4, 4, 4, 4));
        else return P(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12));
    }
    P counts(P m) const { return less(P(double(least)), masses(m)); }
    P inverse(P m) const { return 1.0 / select(counts(m), masses(m), 1.0); }
    static P vectors(P a) {  // 0 beside them
        const typename P::Lanes none{};
        if constexpr (PACKS == 2) return P(__builtin_shufflevector(a.v, none, 8, 1, 2, 3, 8, 5, 6, 7));
        else return P(__builtin_shufflevector(a.v, none, 16, 1, 2, 3, 16, 5, 6, 7, 16, 9, 10, 11, 16, 13, 14, 15));
    }
    static P on_masses(P a) {  // the sums of the vectors, in the place of the masses
        const typename P::Lanes none{};
        if constexpr (PACKS == 2) {
            const auto sum = __builtin_shufflevector(a.v, a.v, 1, 1, 1, 1, 5, 5, 5, 5) +
                             __builtin_shufflevector(a.v, a.v, 2, 2, 2, 2, 6, 6, 6, 6) +
                             __builtin_shufflevector(a.v, a.v, 3, 3, 3, 3, 7, 7, 7, 7);
            return P(__builtin_shufflevector(sum, none, 0, 8, 8, 8, 4, 8, 8, 8));
        } else {
            const auto sum = __builtin_shufflevector(a.v, a.v, 1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13) +
                             __builtin_shufflevector(a.v, a.v, 2, 2, 2, 2, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14, 14, 14) +
                             __builtin_shufflevector(a.v, a.v, 3, 3, 3, 3, 7, 7, 7, 7, 11, 11, 11, 11, 15, 15, 15, 15);
            return P(__builtin_shufflevector(sum, none, 0, 16, 16, 16, 4, 16, 16, 16, 8, 16, 16, 16, 12, 16, 16, 16));
        }
    }
};

}  // namespace tc
