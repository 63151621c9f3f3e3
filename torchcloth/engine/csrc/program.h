// What a substep consists of: fields, index tables, and the stages that read and write them.
#pragma once

#include <algorithm>
#include <cstring>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

#include "row_layout.h"
#include "tape.h"
#include "thread_team.h"

namespace tc {

// Rows of numbers. Weights of a stencil lie by groups of four vertices, so that a stencil reads them one after the
// other.
struct Field {
    FieldKind kind;
    int rows, comps;
    int padded;                      // rows, rounded up to whole packs
    int pitch;                       // numbers between rows, see row_layout.h
    int offset = -1;                 // of state and recorded fields in a record
    bool is_stencil_weight = false;  // rows are [count, neighbours, vertices]
    int neighbours = 0, vertices = 0;
    size_t size() const { return is_stencil_weight ? size_t(rows) / vertices * groups() * 4 : size_t(padded) * pitch; }

    int groups() const { return (vertices + 3) / 4; }
    size_t place(size_t row) const {
        if (!is_stencil_weight) return row * pitch;
        const size_t v = row % vertices, n = row / vertices % neighbours, c = row / vertices / neighbours;
        return ((c * groups() + v / 4) * neighbours + n) * 4 + v % 4;
    }
};

template <class R>
struct Buffer {  // aligned memory, zero at first
    R* data = nullptr;
    size_t size = 0;
    Buffer() = default;
    explicit Buffer(size_t n) { reset(n); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    Buffer(Buffer&& other) noexcept : data(other.data), size(other.size) { other.data = nullptr; other.size = 0; }
    Buffer& operator=(Buffer&& other) noexcept {
        std::swap(data, other.data);
        std::swap(size, other.size);
        return *this;
    }
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

// Points that a broad phase lists, padded to whole packs.
struct PointList {
    std::vector<int> items;
    int count = 0;
};

// Inputs that do not change during a run, in the order in which a loop needs them: [packs, components, lanes].
template <class R>
struct LoopInvariant {
    Buffer<R> packs;
    int version = -1;  // Scene::contact_version for which they were gathered
};

template <class R>
struct ContactState;  // contact.h

// Where a thread finds the fields, and its registers.
template <class R>
struct ThreadView {
    R *const *value, *const *bar, *const *dot;
    Wide<R>*regs, *bars;
    R* dots;      // [register][lane][direction]
    int* picked;  // rows of the items of a pack, by table of the loop
};

// Memory of a thread other than the first: registers, and private sums for rows that several threads add to.
template <class R>
struct ThreadScratch {
    struct Accumulator {
        Buffer<R> memory;
        R* target = nullptr;       // where the sums belong
        size_t low = 0, high = 0;  // numbers that the thread may have added to
    };
    std::vector<R*> value, bar, dot;
    std::vector<Accumulator> values, bars, dots;  // by field
    std::vector<Accumulator*> used;               // in the present loop
    Buffer<Wide<R>> regs_memory, bars_memory;
    Buffer<R> dots_memory;
    std::vector<int> picked;
    ThreadView<R> view() {
        return {value.data(),     bar.data(),       dot.data(),   regs_memory.data,
                bars_memory.data, dots_memory.data, picked.data()};
    }
};

// All that changes in one simulated scene, in several that share the lanes of packs, or in these with some directions.
// As in texts on automatic differentiation, `bar` is an adjoint and `dot` is a tangent.
template <class R>
struct Scene {
    int lanes = 1;  // scenes next to each other: each number of a field, except constants, has one for every scene
    std::vector<R*> value, bar, dot;  // by field; null where there is none
    Buffer<Wide<R>> regs, bars;
    Buffer<R> dots;
    int directions = 0;  // of the tangents
    std::vector<int> picked;
    ThreadView<R> view() {
        return {value.data(), bar.data(), dot.data(), regs.data, bars.data, dots.data, picked.data()};
    }
    ThreadTeam* team = nullptr;
    double min_ops_per_thread = 0;          // operations of a substep that make another thread worth while
    std::vector<ThreadScratch<R>> scratch;  // of the team's threads other than the first
    std::vector<PointList> point_lists;     // by broad phase
    std::vector<int> contact_counts;        // items of the loops over contact points, at this substep
    std::vector<const int*> contact_rows;   // their tables of rows
    std::shared_ptr<ContactState<R>> contact;
    int parts = 1, point_parts = 1;  // into which rows, and contact points, are divided among threads
    std::vector<LoopInvariant<R>> invariants;
    int contact_version = 0;  // how often the list of contact points has changed
    int64_t substep = 0, substeps = 0;
    int32_t* masks = nullptr;  // active triangles, a bit each: [substeps, words]
    bool has_masks = false;    // the masks exist already
};

// Calls f(first row, behind the last one) for the rows of every thread.
template <class R, class F>
void over_rows(const Scene<R>& s, int rows, F f) {
    if (s.parts == 1) return f(0, rows);
    s.team->run(s.parts, [&](int m) { f(begin_of(m, s.parts, rows), begin_of(m + 1, s.parts, rows)); });
}

template <class R>
struct Stage {
    virtual ~Stage() = default;
    virtual void finish() {}                                  // called when all its instructions are there
    virtual double cost(const Scene<R>&) const { return 0; }  // approximate operations on numbers
    virtual void forward(Scene<R>& s) const = 0;
    virtual void tangent(Scene<R>& s) const = 0;
    virtual void reverse(Scene<R>& s) const = 0;            // values of all fields that it reads are there
    virtual void replay(Scene<R>& s) const { forward(s); }  // writes only numbers that are not recorded
    virtual bool runs_in_lanes() const { return true; }     // also several scenes in the lanes of packs
    bool is_replayed = false;  // the reverse sweep replays it, because something that it writes is not recorded
};

template <class R>
struct Program {
    std::vector<Field> fields;
    std::vector<Buffer<R>> constants;      // by field
    std::vector<int> next;                 // by field: of a state, the field at the end of the substep; else -1
    std::vector<std::vector<int>> tables;  // padded to whole packs
    std::vector<std::unique_ptr<Stage<R>>> stages;
    int registers = 0, point_lists = 0, invariants = 0;
    int contact_counts = 0, contact_tables = 0, mask_words = 0;  // sizes of the scene's memory for contact
    size_t state_size = 0, record_size = 0;                      // numbers
    mutable ParallelPolicy policies[3];                          // by run mode
    mutable std::mutex policy_mutex;

    int field(FieldKind kind, int rows, int comps, int neighbours = 0, int vertices = 0) {
        const bool is_weight = neighbours > 0, has_one_row = kind == FieldKind::per_substep;
        fields.push_back({kind, rows, comps, is_weight || has_one_row ? rows : round_up(rows, LANES<float>),
                          is_weight ? comps : pitch_of(comps), -1, is_weight, neighbours, vertices});
        next.push_back(-1);
        constants.emplace_back();
        return int(fields.size()) - 1;
    }
    // Threads that are worth while for a scene.
    int parts(const Scene<R>& s) const {
        if (s.team == nullptr) return 1;
        double sum = 0;
        for (const auto& stage : stages) sum += stage->cost(s);
        return int(std::clamp(sum / s.min_ops_per_thread, 1.0, double(s.team->size)));
    }
    bool runs_in_lanes() const {
        return std::all_of(stages.begin(), stages.end(), [](const auto& stage) { return stage->runs_in_lanes(); });
    }
    void lay_out() {  // states first: the record of a coarse checkpoint is the start of a full one
        record_size = 0;
        for (FieldKind kind : {FieldKind::state, FieldKind::recorded}) {
            for (Field& f : fields)
                if (f.kind == kind) f.offset = int(record_size), record_size += round_up(int(f.size()), LANES<float>);
            if (kind == FieldKind::state) state_size = record_size;
        }
        for (auto& stage : stages) stage->finish();
    }
};

}  // namespace tc
