// Division of the nodes' momentum by their mass: transfer_director_forces and velocity_gradient in
// dynamics/contact/transfer.py.
#pragma once

#include "contact.h"

namespace tc {

// First the two copies of each node in `momentum` (transfer.h) are summed in place; then velocity = momentum / mass. A
// field that has the mass together with the momentum is both arguments. Its stage comes first, and its reverse sweep
// last.
template <class R>
struct GridVelocity : Stage<R> {
    using P = Wide<R>;             // whole nodes
    int mass, momentum, velocity;  // fields of nodes
    R min_mass;                    // a smaller mass has no effect, and its square underflows

    GridVelocity(int mass, int momentum, int velocity, R min_mass)
        : mass(mass), momentum(momentum), velocity(velocity), min_mass(min_mass) {
        this->is_replayed = true;
    }

    bool runs_in_lanes() const override { return false; }
    void forward(Scene<R>& s) const override {
        if (!sum_copies(s, s.value[momentum], 1)) return;
        const P *m = at(s.value[mass]), *from = at(s.value[momentum]);
        P* to = at(s.value[velocity]);
        over_blocks(s, [&](int first, int last) {
            for (int i = PACKS * first; i < PACKS * last; i++) to[i] = keep_vectors(from[i] * inverse(m[i]));
        });
    }
    void reverse(Scene<R>& s) const override {
        if (s.contact->points.size() == 0) return;
        const P *m = at(s.value[mass]), *quotient = at(s.value[velocity]), *seed = at(s.bar[velocity]);
        P *by_mass = at(s.bar[mass]), *by_momentum = at(s.bar[momentum]);
        over_blocks(s, [&](int first, int last) {
            for (int i = PACKS * first; i < PACKS * last; i++) {
                const P g = keep_vectors(seed[i] * inverse(m[i])), product = g * quotient[i];
                by_momentum[i] = by_momentum[i] + g;
                by_mass[i] = by_mass[i] - has_mass(m[i]) * sum_to_mass(product);
            }
        });
        sum_copies(s, s.bar[momentum], 1);
    }
    void tangent(Scene<R>& s) const override {
        forward(s);
        if (!sum_copies(s, s.dot[momentum], s.directions)) return;
        const P *m = at(s.value[mass]), *quotient = at(s.value[velocity]), *m_dot = at(s.dot[mass]),
                *from = at(s.dot[momentum]);
        P* to = at(s.dot[velocity]);
        over_blocks(s, [&](int first, int last) {
            for (int block = first; block < last; block++)
                for (int p = 0; p < PACKS; p++) {
                    const P node_mass = m[PACKS * block + p], over_mass = inverse(node_mass);
                    const P factor = over_mass * has_mass(node_mass) * quotient[PACKS * block + p];
                    for (int d = 0; d < s.directions; d++) {
                        const size_t i = size_t(PACKS) * (block * s.directions + d) + p;
                        to[i] = keep_vectors(from[i] * over_mass - broadcast_mass(m_dot[i]) * factor);
                    }
                }
        });
    }

  private:
    static constexpr int PACKS = BLOCK_NUMBERS / LANES<R>;
    static P* at(R* field) { return reinterpret_cast<P*>(field); }

    // The last two nodes of a block are the first two of the block above, and threads may have copies of both. All
    // copies get the sum. Returns false if there are no points.
    static bool sum_copies(Scene<R>& s, R* field, int depth) {
        if (s.contact->points.size() == 0) return false;
        const SparseGrid<R>& nodes = s.contact->nodes;
        over_blocks(s, [&](int first, int last) {
            for (int b = std::max(first, 1); b < last; b++) {
                const int above = nodes.block_above[b];
                if (above < 0) continue;
                if (nodes.next_copy[b] == 0 && (above == 0 || nodes.next_copy[above] == 0)) {
                    if (above == 0) continue;
                    for (int k = 0; k < depth; k++) {
                        Half &upper = half(field, b, 1, k, depth), &lower = half(field, above, 0, k, depth);
                        upper = lower = upper + lower;
                    }
                    continue;
                }
                sum_block_copies(nodes, field, depth, b, above);
                if (nodes.is_lowest[b]) sum_block_copies(nodes, field, depth, 0, b);
            }
        });
        return true;
    }
    using Half = Pack<R, BLOCK_NUMBERS / 2>;
    static Half& half(R* field, int block, int which, int k, int depth) {
        return *reinterpret_cast<Half*>(field + (size_t(block) * depth + k) * BLOCK_NUMBERS +
                                        which * (BLOCK_NUMBERS / 2));
    }
    // Sums the upper halves of the copies of one block, and the lower halves of those of another; 0: no block.
    static void sum_block_copies(const SparseGrid<R>& nodes, R* field, int depth, int below, int above) {
        for (int k = 0; k < depth; k++) {
            Half sum(0.0);
            auto each = [&](auto f) {
                if (below) nodes.for_each_copy(below, [&](int b) { f(half(field, b, 1, k, depth)); });
                if (above) nodes.for_each_copy(above, [&](int b) { f(half(field, b, 0, k, depth)); });
            };
            each([&](Half& numbers) { sum = sum + numbers; });
            each([&](Half& numbers) { numbers = sum; });
        }
    }
    static P broadcast_mass(P a) {
        if constexpr (PACKS == 2) return P(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 4, 4, 4, 4));
        else return P(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12));
    }
    P has_mass(P m) const { return less(P(double(min_mass)), broadcast_mass(m)); }
    P inverse(P m) const { return 1.0 / select(has_mass(m), broadcast_mass(m), 1.0); }
    static P keep_vectors(P a) {  // 0 in the place of the masses
        const typename P::Lanes none{};
        if constexpr (PACKS == 2) return P(__builtin_shufflevector(a.v, none, 8, 1, 2, 3, 8, 5, 6, 7));
        else return P(__builtin_shufflevector(a.v, none, 16, 1, 2, 3, 16, 5, 6, 7, 16, 9, 10, 11, 16, 13, 14, 15));
    }
    static P sum_to_mass(P a) {  // the sums of the vectors, in the place of the masses
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
