// What points gave to the nodes, over the nodes' mass: transfer.push, transfer.velocity_gradient.
#pragma once

#include "contact.h"

namespace tc {

// given: first the two copies of each node (transfer.h) are added up, in place; out = vector of given / mass. For what
// has the mass itself beside the vector, given is the mass; it comes first, and its reverse sweep last.
template <class R>
struct PerMass : Stage<R> {
    using B = Block<R>;
    int mass, given, out;  // fields of nodes
    R least;               // less mass than that has no say, and its square underflows

    PerMass(int mass, int given, int out, R least) : mass(mass), given(given), out(out), least(least) { this->again = true; }

    void forward(Scene<R>& s) const override {
        if (!join(s, s.value[given], 1)) return;
        const B *m = at(s.value[mass]), *from = at(s.value[given]);
        B* to = at(s.value[out]);
        for (int b = 1; b < s.layers->nodes.count(); b++) to[b] = vectors(from[b] * inverse(m[b]));
    }
    void reverse(Scene<R>& s) const override {
        if (s.layers->points.size() == 0) return;
        const B *m = at(s.value[mass]), *quotient = at(s.value[out]), *seed = at(s.bar[out]);
        B *by_mass = at(s.bar[mass]), *by_given = at(s.bar[given]);
        for (int b = 1; b < s.layers->nodes.count(); b++) {
            const B g = vectors(seed[b] * inverse(m[b])), work = g * quotient[b];
            by_given[b] = by_given[b] + g;
            by_mass[b] = by_mass[b] - counts(m[b]) * on_masses(work);
        }
        join(s, s.bar[given], 1);
    }
    void tangent(Scene<R>& s) const override {
        forward(s);
        if (!join(s, s.dot[given], DIRECTIONS)) return;
        const R *m = s.value[mass], *quotient = s.value[out];
        const Node *m_dot = node(s.dot[mass]), *from = node(s.dot[given]);
        Node* to = node(s.dot[out]);
        for (int n = 4; n < 4 * s.layers->nodes.count(); n++) {
            const R own = m[n * ON_NODE];
            const bool counts = own > least;
            const Node moved = counts ? m_dot[n] : Node(0.0);
            const Quad<R> by_mass = chunk_of(moved), there = reinterpret_cast<const Quad<R>*>(quotient)[n];
            const Node change = (from[n] - widened(there) * repeated(by_mass)) * alike(counts ? 1 / own : R(1));
            to[n] = without_mass(change);
        }
    }

  private:
    using Node = Pack<R, ON_NODE * DIRECTIONS>;  // four directions of each of the four numbers
    static B* at(R* field) { return reinterpret_cast<B*>(field); }
    static Node* node(R* field) { return reinterpret_cast<Node*>(field); }

    // The last two nodes of a block are the first two of the one above: both get the sum. False: there are no points.
    static bool join(Scene<R>& s, R* field, int depth) {
        const auto& above = s.layers->nodes.above;
        if (s.layers->points.size() == 0) return false;
        struct Half {
            Pack<R, 8> numbers;
        };
        for (size_t b = 1; b < above.size(); b++) {
            if (above[b] == 0) continue;
            Half* upper = reinterpret_cast<Half*>(field + (b * ON_BLOCK + ON_BLOCK / 2) * depth);
            Half* lower = reinterpret_cast<Half*>(field + size_t(above[b]) * ON_BLOCK * depth);
            for (int k = 0; k < depth; k++) upper[k].numbers = lower[k].numbers = upper[k].numbers + lower[k].numbers;
        }
        return true;
    }
    static B masses(B a) {
        return B(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12));
    }
    B counts(B m) const { return less(alike(least), masses(m)); }
    B inverse(B m) const { return 1.0 / select(counts(m), masses(m), 1.0); }
    static B vectors(B a) {  // 0 beside them
        const typename B::Lanes none{};
        return B(__builtin_shufflevector(a.v, none, 16, 1, 2, 3, 16, 5, 6, 7, 16, 9, 10, 11, 16, 13, 14, 15));
    }
    static B on_masses(B a) {  // the sums of the vectors, in the place of the masses
        const auto sum = __builtin_shufflevector(a.v, a.v, 1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13) +
                         __builtin_shufflevector(a.v, a.v, 2, 2, 2, 2, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14, 14, 14) +
                         __builtin_shufflevector(a.v, a.v, 3, 3, 3, 3, 7, 7, 7, 7, 11, 11, 11, 11, 15, 15, 15, 15);
        const typename B::Lanes none{};
        return B(__builtin_shufflevector(sum, none, 0, 16, 16, 16, 4, 16, 16, 16, 8, 16, 16, 16, 12, 16, 16, 16));
    }
    static Quad<R> chunk_of(Node a) { return Quad<R>(__builtin_shufflevector(a.v, a.v, 0, 1, 2, 3)); }
    static Node without_mass(Node a) {
        const typename Node::Lanes none{};
        return Node(__builtin_shufflevector(a.v, none, 16, 16, 16, 16, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
    }
};

}  // namespace tc
