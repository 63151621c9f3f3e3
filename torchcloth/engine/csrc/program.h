// What a substep is made of: fields, index tables, and the stages that read and write them.
#pragma once

#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "rows.h"
#include "tape.h"

namespace tc {

// constant: of the mesh. parameter: an input with a derivative. state: at the start of the substep; its `next` at the
// end. temporary: within a substep; a kept one is recorded, because the reverse sweep reads it. drive: one row per
// substep. sum: added up over all substeps. nodes, points: of contact, which sees to their memory; what loops over points
// tell each other lies there as in registers, pack by pack.
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

constexpr int WOKEN_LIST = 7;  // where rows begin that contact lists anew at every substep: contact.h

template <class R>
struct Layers;  // contact.h

// One simulated scene, or one scene with some directions: everything that changes.
template <class R>
struct Scene {
    std::vector<R*> value, bar, dot;  // by field; null where there is none
    Buffer<Wide<R>> regs, bars;
    Buffer<Along<R>> dots;            // [register][lane]
    std::vector<List> lists;          // by sieve
    std::vector<int> picked;          // rows of the items of a pack, by table of the loop
    // What contact between layers decides anew at every substep: how many items some loops have, and which rows.
    std::vector<int> counts;
    std::vector<const int*> rows;
    std::shared_ptr<Layers<R>> layers;
    std::vector<Fixed<R>> fixed;
    int lists_made = 0;  // how often contact listed other points
    int64_t substep = 0, substeps = 0;
    int32_t* masks = nullptr;  // triangles that take part, a bit each: [substeps, words]
    bool knows = false;        // masks are there already
};

template <class R>
struct Stage {
    virtual ~Stage() = default;
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

    int field(Kind kind, int rows, int comps, int near = 0, int vertices = 0) {
        const bool raw = near > 0, plain = raw || kind == Kind::drive;
        fields.push_back({kind, rows, comps, plain ? rows : round_up(rows, LANES<float>), plain ? comps : pitch_of(comps), -1,
                          raw, near, vertices});
        next.push_back(-1);
        constants.emplace_back();
        return int(fields.size()) - 1;
    }
    void lay_out() {  // states first: the record of a coarse checkpoint is the start of a full one
        record_size = 0;
        for (Kind kind : {Kind::state, Kind::kept}) {
            for (Field& f : fields)
                if (f.kind == kind) f.offset = int(record_size), record_size += round_up(int(f.size()), LANES<float>);
            if (kind == Kind::state) state_size = record_size;
        }
    }
};

}  // namespace tc
