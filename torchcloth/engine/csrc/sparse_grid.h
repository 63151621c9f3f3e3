// The blocks of grid nodes near contact points, numbered as they appear. Positions may be anywhere: a hash table leads
// to the blocks. Where several threads share the points, each part of the points has blocks of its own, so that a block
// may have several copies.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>
#include <vector>

#include "contact_points.h"
#include "program.h"
#include "transfer.h"

namespace tc {

template <class R>
struct SparseGrid {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    std::vector<int> blocks_of_point;  // [points, BLOCKS_PER_POINT]
    std::vector<int> block_above;      // by block: whose first two nodes are this one's last two; 0: none; -1: a copy
    std::vector<int> next_copy;        // by block: a copy of a later part (the first may be of any part); 0: none
    std::vector<bool> is_lowest;       // by block: it is above no other
    Buffer<P> lowest_node;             // [packs, 3] where each point's blocks begin, in grid spacings
    // Count of an empty block, the blocks in use, and some that no point uses any more.
    int count() const { return int(block_above.size()); }
    // Where the blocks of a part begin; the last part also has all that were inserted later.
    int part_begin(int m) const { return m < int(part_begins.size()) ? part_begins[m] : count(); }

    // Calls f for all copies of a block in the order of their parts, so that sums do not depend on the order of
    // insertion.
    template <class F>
    void for_each_copy(int first, F f) const {
        bool is_first_pending = true;
        for (int b = next_copy[first]; b != 0; b = next_copy[b]) {
            if (is_first_pending && part_of[first] < part_of[b]) f(first), is_first_pending = false;
            f(b);
        }
        if (is_first_pending) f(first);
    }

    void start(size_t points) { lowest_node.reset(size_t(round_up(int(points), L)) / L * 3); }

    // Updates the blocks of all points, on a grid that lies elsewhere in every substep. Points whose cell has changed
    // are looked up.
    void update(const ContactPoints<R>& points, const R* x, R spacing, const R* shift, bool all_new, int parts,
                ThreadTeam* team) {
        const int size = points.size(), packs = (size + L - 1) / L;
        if (size == 0) return;
        if (all_new || count() > 2 * blocks_after_reset + 64) {
            reset(size, parts);
            all_new = true;
        }
        auto check = [&](int part) {
            for (int pack = begin_of(part, parts, packs); pack < begin_of(part + 1, parts, packs); pack++)
                moved_lanes[pack] = find_moved(points, pack, x, spacing, shift, all_new);
        };
        if (parts == 1) check(0);
        else team->run(parts, check);
        for (int part = 0; part < parts; part++) {
            if (all_new) part_begins[part] = count();
            for (int pack = begin_of(part, parts, packs); pack < begin_of(part + 1, parts, packs); pack++)
                for (unsigned left = moved_lanes[pack]; left != 0; left &= left - 1) {
                    const int lane = std::countr_zero(left), point = pack * L + lane;
                    const P* low = lowest_node.data + 3 * pack;
                    insert_blocks(int64_t(low[0][lane]), int64_t(low[1][lane]), int64_t(low[2][lane]), part,
                                  &blocks_of_point[size_t(point) * BLOCKS_PER_POINT]);
                }
        }
        if (all_new) blocks_after_reset = count();
    }

  private:
    std::vector<int64_t> key;         // of a hash table with open addressing; -1: free
    std::vector<int> block_number;    // by slot of the hash table
    std::vector<int> part_of;         // by block
    std::vector<int> part_begins;     // by part
    int blocks_after_reset = 0;       // count of blocks when all points were last looked up
    std::vector<unsigned> moved_lanes;  // by pack: a bit for each point that has other nodes

    // A bit for each point of a pack whose nodes have changed; stores the points' lowest nodes.
    unsigned find_moved(const ContactPoints<R>& points, int pack, const R* x, R spacing, const R* shift,
                        bool all_new) {
        const int lanes = std::min(L, points.size() - pack * L);
        P low[3], *before = lowest_node.data + 3 * pack, same(1.0);
        locate(points, pack * L, x, spacing, shift, low);
        for (int d = 0; d < 3; d++) same = same * (1.0 - abs(less(low[d], before[d]) + less(before[d], low[d])));
        if (!all_new && total(same) == L) return 0;
        unsigned moved = 0;
        for (int lane = 0; lane < lanes; lane++) moved |= unsigned(all_new || same[lane] != 1) << lane;
        for (int d = 0; d < 3; d++) before[d] = low[d];
        return moved;
    }
    // Computes where the blocks of a pack's points begin: at the lowest node along x and y, along z at an even one.
    static void locate(const ContactPoints<R>& points, int first, const R* x, R spacing, const R* shift, P* low) {
        const int last = points.size() - 1;
        P at[3] = {P(0.0), P(0.0), P(0.0)};
        for (int c = 0; c < 3; c++) {
            P corner[4];
            const int* vertex = points.corner[c].data();
            auto position = [&](int lane) {
                return x + size_t(vertex[first + lane < last ? first + lane : last]) * VERTEX_PITCH;
            };
            gather_quads(position, corner);
            for (int d = 0; d < 3; d++) at[d] = at[d] + points.weight[first / L * 3 + c] * corner[d];
        }
        for (int d = 0; d < 3; d++) {
            const R width = d == 2 ? 2 : 1;
            for (int lane = 0; lane < L; lane++)
                low[d].v[lane] = width * std::floor((at[d].v[lane] / spacing + shift[d] - R(0.5)) / width);
        }
    }
    void reset(int points, int parts) {
        part_begins.assign(parts, 0);
        moved_lanes.assign(size_t(points + L - 1) / L, 0);
        blocks_of_point.assign(size_t(points) * BLOCKS_PER_POINT, 0);
        key.assign(1024, -1), block_number.assign(1024, 0);
        block_above.assign(1, 0), next_copy.assign(1, 0), part_of.assign(1, 0), is_lowest.assign(1, false);
    }
    void insert_blocks(int64_t x, int64_t y, int64_t z, int part, int* out) {
        for (int64_t i = 0; i < 3; i++)
            for (int64_t j = 0; j < 3; j++) *out++ = find_or_insert(x + i, y + j, z >> 1, part);
    }
    static int64_t key_of(int64_t x, int64_t y, int64_t z) {
        constexpr int64_t bits = (1 << 21) - 1;
        return (x & bits) << 42 | (y & bits) << 21 | (z & bits);
    }
    int find_or_insert(int64_t x, int64_t y, int64_t z, int part) {
        if (size_t(count()) * 3 > key.size()) grow();
        const size_t at = slot_of(key_of(x, y, z));
        const int added = count();
        if (key[at] != -1) {
            int block = block_number[at];
            if (part_of[block] == part) return block;
            while (next_copy[block] != 0 && part_of[next_copy[block]] < part) block = next_copy[block];
            const int next = next_copy[block];
            if (next != 0 && part_of[next] == part) return next;
            next_copy[block] = added;
            block_above.push_back(-1), is_lowest.push_back(false), next_copy.push_back(next), part_of.push_back(part);
            return added;
        } else {
            const int below = block_number[slot_of(key_of(x, y, z - 1))],
                      above = block_number[slot_of(key_of(x, y, z + 1))];
            if (below) block_above[below] = added;
            if (above) is_lowest[above] = false;
            block_above.push_back(above), is_lowest.push_back(below == 0), next_copy.push_back(0),
                part_of.push_back(part);
            key[at] = key_of(x, y, z), block_number[at] = added;
            return added;
        }
    }
    // Slot of a key in the hash table, or the free slot for it, where the block number is 0.
    size_t slot_of(int64_t wanted) const {
        // high bits depend on the whole key
        size_t at = (uint64_t(wanted) * 0x9E3779B97F4A7C15ull >> 43) & (key.size() - 1);
        while (key[at] != -1 && key[at] != wanted) at = (at + 1) & (key.size() - 1);
        return at;
    }
    void grow() {
        std::vector<int64_t> old_key(4 * key.size(), -1);
        std::vector<int> old_number(4 * key.size(), 0);
        old_key.swap(key), old_number.swap(block_number);
        for (size_t i = 0; i < old_key.size(); i++)
            if (old_key[i] != -1) {
                const size_t at = slot_of(old_key[i]);
                key[at] = old_key[i], block_number[at] = old_number[i];
            }
    }
};

}  // namespace tc
