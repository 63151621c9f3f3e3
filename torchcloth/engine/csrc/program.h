// What a substep is made of: fields, index tables, and the stages that read and write them.
#pragma once

#include <algorithm>
#include <cstring>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

#include "rows.h"
#include "tape.h"
#include "team.h"

namespace tc {

// constant: of the mesh. parameter: an input with a derivative. state: at the start of the substep; its `next` at the
// end. temporary: within a substep; a kept one is recorded, because the reverse sweep reads it. drive: one row per
// substep. sum: added up over the substeps of a frame. nodes, points: of contact, which sees to their memory; what loops
// over points tell each other lies there as in registers, pack by pack.
enum class Kind : int { constant, parameter, state, next, temporary, kept, drive, sum, nodes, points };

struct Field {
    Kind kind;
    int rows, comps;
    int padded;        // rows, rounded up to whole packs
    int pitch;         // numbers between rows, see rows.h
    int offset = -1;   // of state and kept fields in a record
    bool raw = false;  // weights of a stencil [count, near, vertices]
    int near = 0, vertices = 0;
    size_t size() const { return raw ? size_t(rows) / vertices * groups() * 4 : size_t(padded) * pitch; }

    // Weights lie by groups of four vertices, so that a stencil reads them one after the other.
    int groups() const { return (vertices + 3) / 4; }
    size_t place(size_t row) const {
        if (!raw) return row * pitch;
        const size_t v = row % vertices, n = row / vertices % near, c = row / vertices / near;
        return ((c * groups() + v / 4) * near + n) * 4 + v % 4;
    }
};

template <class R>
struct Buffer {  // aligned, zero at first
    R* data = nullptr;
    size_t size = 0;
    Buffer() = default;
    explicit Buffer(size_t n) { reset(n); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    Buffer(Buffer&& other) noexcept : data(other.data), size(other.size) { other.data = nullptr; other.size = 0; }
    Buffer& operator=(Buffer&& other) noexcept { std::swap(data, other.data); std::swap(size, other.size); return *this; }
    ~Buffer() { std::free(data); }
    void reset(size_t n) {
        std::free(data);
        size = n;
        const size_t bytes = (n * sizeof(R) + WIDTH - 1) / WIDTH * WIDTH + WIDTH;
        data = static_cast<R*>(std::aligned_alloc(WIDTH, bytes));
        if (data == nullptr) throw std::bad_alloc();
        std::memset(static_cast<void*>(data), 0, bytes);
    }
    void clear() { std::memset(static_cast<void*>(data), 0, size * sizeof(R)); }
};

// Items that a sieve has found, padded to whole packs.
struct List {
    std::vector<int> items;
    int count = 0;
};

// Inputs in the order in which a loop needs them: [packs, components, lanes].
template <class R>
struct Fixed {
    Buffer<R> packs;
    int made = -1;  // for which lists of contact
};

// Rows that contact lists, in the order of engine/lowerings/contact.py: of points, of those woken and those asleep, from the
// seventh on anew at every substep. OWN_ROW: no two points have the same there.
enum Listed { POINTS_LIST, OWN_ROW = 4, WOKEN_LIST = 7, ASLEEP_LIST = 13, LISTS = 19 };

template <class R>
struct Layers;  // contact.h

// Where a thread finds the fields, and its registers.
template <class R>
struct View {
    R *const *value, *const *bar, *const *dot;
    Wide<R>*regs, *bars;
    R* dots;         // [register][lane][direction]
    int* picked;     // rows of the items of a pack, by table of the loop
};

// What a thread beside the first one needs: registers, and memory for what several add to at once.
template <class R>
struct Desk {
    struct Share {
        Buffer<R> memory;
        R* to = nullptr;
        size_t low = 0, high = 0;  // numbers that it may have added to
    };
    std::vector<R*> value, bar, dot;
    std::vector<Share> values, bars, dots;  // by field
    std::vector<Share*> used;               // in the present loop
    Buffer<Wide<R>> own_regs, own_bars;
    Buffer<R> own_dots;
    std::vector<int> picked;
    View<R> view() { return {value.data(), bar.data(), dot.data(), own_regs.data, own_bars.data, own_dots.data, picked.data()}; }
};

// One simulated scene, or one scene with some directions: everything that changes.
template <class R>
struct Scene {
    std::vector<R*> value, bar, dot;  // by field; null where there is none
    Buffer<Wide<R>> regs, bars;
    Buffer<R> dots;
    int directions = 0;  // in it
    std::vector<int> picked;
    View<R> view() { return {value.data(), bar.data(), dot.data(), regs.data, bars.data, dots.data, picked.data()}; }
    Team* team = nullptr;
    double worth = 0;                 // operations of a substep for which another thread is worth while
    std::vector<Desk<R>> desks;       // of the team's members beside the first
    std::vector<List> lists;          // by sieve
    // What contact between layers decides anew at every substep: how many items some loops have, and which rows.
    std::vector<int> counts;
    std::vector<const int*> rows;
    std::shared_ptr<Layers<R>> layers;
    int parts = 1, point_parts = 1;  // into which rows, and points of contact, are divided among threads
    std::vector<Fixed<R>> fixed;
    int lists_made = 0;  // how often contact listed other points
    int64_t substep = 0, substeps = 0;
    int32_t* masks = nullptr;  // triangles that take part, a bit each: [substeps, words]
    bool knows = false;        // masks are there already
};

// f(first row, behind the last one) for the rows of every thread.
template <class R, class F>
void over_rows(const Scene<R>& s, int rows, F f) {
    if (s.parts == 1) return f(0, rows);
    s.team->run(s.parts, [&](int m) { f(begin_of(m, s.parts, rows), begin_of(m + 1, s.parts, rows)); });
}

template <class R>
struct Stage {
    virtual ~Stage() = default;
    virtual void ready() {}  // all its instructions are there
    virtual double cost(const Scene<R>&) const { return 0; }  // operations on numbers, about
    virtual void forward(Scene<R>& s) const = 0;
    virtual void tangent(Scene<R>& s) const = 0;
    virtual void reverse(Scene<R>& s) const = 0;  // values of all that it reads are there
    virtual void replay(Scene<R>& s) const { forward(s); }  // writes only what is not recorded
    bool again = false;  // something that it writes is not recorded: the reverse sweep replays it
};

template <class R>
struct Program {
    std::vector<Field> fields;
    std::vector<Buffer<R>> constants;  // by field
    std::vector<int> next;  // by field: of a state, where it goes; else -1
    std::vector<std::vector<int>> tables;  // padded to whole packs
    std::vector<std::unique_ptr<Stage<R>>> stages;
    int registers = 0, lists = 0, fixed = 0;
    int counts = 0, rows = 0, words = 0;  // sizes of what Scene has for contact
    size_t state_size = 0, record_size = 0;  // numbers
    mutable Habit habits[3];  // by mode; guard them
    mutable std::mutex guard;

    int field(Kind kind, int rows, int comps, int near = 0, int vertices = 0) {
        const bool raw = near > 0, plain = raw || kind == Kind::drive;
        fields.push_back({kind, rows, comps, plain ? rows : round_up(rows, LANES<float>), plain ? comps : pitch_of(comps), -1,
                          raw, near, vertices});
        next.push_back(-1);
        constants.emplace_back();
        return int(fields.size()) - 1;
    }
    // As many as are worth it.
    int parts(const Scene<R>& s) const {
        if (s.team == nullptr) return 1;
        double sum = 0;
        for (const auto& stage : stages) sum += stage->cost(s);
        return int(std::clamp(sum / s.worth, 1.0, double(s.team->size)));
    }
    void lay_out() {  // states first: the record of a coarse checkpoint is the start of a full one
        record_size = 0;
        for (Kind kind : {Kind::state, Kind::kept}) {
            for (Field& f : fields)
                if (f.kind == kind) f.offset = int(record_size), record_size += round_up(int(f.size()), LANES<float>);
            if (kind == Kind::state) state_size = record_size;
        }
        for (auto& stage : stages) stage->ready();
    }
};

}  // namespace tc
