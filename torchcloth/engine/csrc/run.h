// Many substeps of many scenes: values with records, the reverse sweep from them, and tangents.
#pragma once

#include <algorithm>
#include <exception>
#include <mutex>

#include "program.h"

namespace tc {

// What the caller hands in and gets back for one field, each [scenes, rows, components] or, for drives,
// [scenes, substeps, components], and for results of values [scenes, frames, rows, components]; tangents have the
// directions after the scenes. Null: not given, not wanted.
struct Port {
    const void* value;    // of parameters, states, drives
    int64_t stride;       // numbers between scenes; 0: all share one
    void* result;         // of nexts and sums
    const void* seed;     // adjoint of nexts and sums
    void* gradient;       // of parameters, states, drives
    const void* dot;      // tangents of parameters, states, drives: [scenes or 1, directions, ...]
    int64_t dot_stride;   // likewise
    void* dot_result;     // of nexts and sums
};

struct Call {
    const Port* ports;  // by field
    int64_t scenes, substeps, directions, threads;
    void* records;      // [scenes, records_size]
    int64_t every;      // substeps between records; 0: none
    double worth;       // operations of a substep for which another thread is worth while
    const int64_t* ends;  // of values: substeps after which there are results
    int64_t frames;       // how many those are
};

// Numbers for one scene: [1 + ceil(substeps / every), record_size, or state_size where every > 1], then the triangles
// in contact, as integers [substeps, words].
template <class R>
size_t records_size(const Program<R>& p, int64_t substeps, int64_t every) {
    if (every == 0) return 0;
    const size_t masks = (size_t(substeps) * p.words * sizeof(int32_t) + sizeof(R) - 1) / sizeof(R);
    const size_t rows = size_t(1 + (substeps + every - 1) / every) * (every == 1 ? p.record_size : p.state_size);
    return (rows + masks + LANES<R> - 1) / LANES<R> * LANES<R>;  // the next scene's begin on a cache line
}

template <class R>
class Run {
    static constexpr int64_t LONG = 4;  // substeps that are worth the start of a second thread
    const Program<R>& program;
    const Call& call;

    struct Memory {
        std::unique_ptr<Team> team;
        Scene<R> scene;
        std::vector<Buffer<R>> values, bars, dots;  // by field, owned
        std::vector<size_t> temporaries;            // fields that start each substep at zero
        Buffer<R> rows;                             // of a record: what is not recorded
    };

  public:
    Run(const Program<R>& p, const Call& c) : program(p), call(c) {}

    void forward() {
        each(call.scenes, [&](int64_t scene) {
            Memory m = memory(scene, Mode::value, call.scenes);
            R* first = call.every ? record(scene, 0) : nullptr;
            if (call.every) clear_record(scene, call.every == 1 ? 0 : (call.substeps + call.every - 1) / call.every);
            m.rows.reset(2 * program.record_size);
            R *row = call.every == 1 ? first : m.rows.data, *after = nullptr;
            start(m, scene, row);
            int64_t frame = 0;
            for (int64_t k = 0; k < call.substeps; k++) {
                if (call.every > 1 && k % call.every == 0) save(record(scene, k / call.every), row);
                if (call.every == 1) clear_record(scene, k + 1);
                after = call.every == 1 ? record(scene, k + 1) : other(m, row);
                substep(m, scene, k, row, after);
                row = after;
                if (k + 1 == call.ends[frame] && frame + 1 < call.frames) finish(m, scene, row, frame++);
            }
            finish(m, scene, row, frame);
            learn(m, Mode::value);
        });
    }

    void reverse() {
        each(call.scenes, [&](int64_t scene) {
            Memory m = memory(scene, Mode::reverse, call.scenes);
            seed(m, scene);
            const int64_t every = call.every;
            if (every > 1) m.rows.reset((every + 1) * program.record_size);
            for (int64_t first = (call.substeps - 1) / every * every; first >= 0; first -= every) {
                const int64_t last = std::min(first + every, call.substeps);
                auto row = [&](int64_t k) { return every == 1 ? record(scene, k) : m.rows.data + (k - first) * program.record_size; };
                if (every > 1) {
                    std::memcpy(row(first), record(scene, first / every), program.state_size * sizeof(R));
                    for (int64_t k = first; k < last; k++) substep(m, scene, k, row(k), row(k + 1));
                }
                for (int64_t k = last - 1; k >= first; k--) back(m, scene, k, row(k), row(k + 1));
            }
            gradients(m, scene);
            learn(m, Mode::reverse);
        });
    }

    void tangent() {
        const std::vector<Group> all = groups();
        const int64_t count = int64_t(all.size());
        each(call.scenes * count, [&](int64_t task) {
            const int64_t scene = task / count;
            const Group& group = all[task % count];
            Memory m = memory(scene, Mode::tangent, call.scenes * count, group.size);
            load_dots(m, scene, group);
            m.rows.reset(2 * program.record_size);
            R *row = m.rows.data, *after = nullptr;
            start(m, scene, row);
            for (int64_t k = 0; k < call.substeps; k++) {
                after = other(m, row);
                point(m, scene, k, row, after);
                for (const auto& stage : program.stages) stage->tangent(m.scene);
                for (size_t f = 0; f < program.fields.size(); f++)
                    if (program.next[f] >= 0) std::swap(m.scene.dot[f], m.scene.dot[program.next[f]]);
                row = after;
            }
            if (group.first == 0) finish(m, scene, row, 0);
            save_dots(m, scene, group);
            learn(m, Mode::tangent);
        });
    }

  private:
    enum class Mode { value, reverse, tangent };

    template <class F>
    void each(int64_t tasks, F work) {
        const int64_t workers = std::max<int64_t>(1, std::min(call.threads, tasks));
        const Seats seats{int(workers)};
        std::atomic<int64_t> next{0};
        std::exception_ptr failure;
        std::mutex guard;
        auto loop = [&] {
            [[maybe_unused]] const Flush flush;
            try {
                for (int64_t task; (task = next++) < tasks;) work(task);
            } catch (...) {
                std::lock_guard<std::mutex> lock(guard);
                failure = std::current_exception();
            }
        };
        std::vector<std::thread> threads;
        try {
            threads.reserve(workers - 1);
            for (int64_t i = 1; i < workers; i++) threads.emplace_back(loop);
        } catch (const std::exception&) {  // no more are to be had: those that are do all of it
        }
        loop();
        for (auto& thread : threads) thread.join();
        if (failure) std::rethrow_exception(failure);
    }

    R* record(int64_t scene, int64_t k) const {
        const size_t size = call.every == 1 ? program.record_size : program.state_size;
        return static_cast<R*>(call.records) + scene * records_size(program, call.substeps, call.every) + k * size;
    }
    // What no substep writes: lanes beyond the last row, and the last record or its end. Results are then reproducible.
    void clear_record(int64_t scene, int64_t k) const {
        const size_t size = k == call.substeps && call.every == 1 ? program.record_size : program.state_size;
        std::memset(static_cast<void*>(record(scene, k)), 0, size * sizeof(R));
    }
    R* other(const Memory& m, const R* row) const {
        return row == m.rows.data ? m.rows.data + program.record_size : m.rows.data;
    }
    void save(R* to, const R* row) const { std::memcpy(to, row, program.state_size * sizeof(R)); }

    static bool is_input(Kind kind) { return kind == Kind::parameter || kind == Kind::drive; }
    static bool is_within(Kind kind) { return kind == Kind::temporary || kind == Kind::kept; }
    size_t size_of(const Field& f) const { return f.kind == Kind::drive ? size_t(call.substeps) * f.comps : f.size(); }

    // Of one of so many tasks; with tangents along so many directions.
    Memory memory(int64_t scene, Mode mode, int64_t tasks, int directions = 0) const {
        Memory m;
        const size_t count = program.fields.size();
        m.scene.value.assign(count, nullptr), m.scene.bar.assign(count, nullptr), m.scene.dot.assign(count, nullptr);
        m.values.resize(count), m.bars.resize(count), m.dots.resize(count);
        m.scene.counts.assign(program.counts, 0), m.scene.rows.assign(program.rows, nullptr);
        m.scene.substeps = call.substeps, m.scene.knows = mode == Mode::reverse;
        m.scene.masks = call.every ? reinterpret_cast<int32_t*>(record(scene, 1 + (call.substeps + call.every - 1) / call.every)) : nullptr;
        m.scene.regs.reset(program.registers), m.scene.lists.resize(program.lists);
        m.scene.fixed.resize(program.fixed);
        if (mode == Mode::reverse) m.scene.bars.reset(program.registers);
        if (mode == Mode::tangent) m.scene.directions = directions, m.scene.dots.reset(size_t(program.registers) * LANES<R> * directions);
        for (size_t f = 0; f < count; f++) {
            const Field& field = program.fields[f];
            if (field.kind == Kind::constant) { m.scene.value[f] = program.constants[f].data; continue; }
            if (field.kind == Kind::nodes || field.kind == Kind::points) continue;
            if (is_within(field.kind)) m.temporaries.push_back(f);
            if (field.kind == Kind::temporary || field.kind == Kind::sum || is_input(field.kind)) {
                m.values[f].reset(size_of(field));
                m.scene.value[f] = m.values[f].data;
            }
            if (is_input(field.kind)) load(m.values[f].data, field, call.ports[f].value, scene * call.ports[f].stride, 1);
            if (mode == Mode::reverse && (!is_input(field.kind) || call.ports[f].gradient)) {
                m.bars[f].reset(size_of(field));
                m.scene.bar[f] = m.bars[f].data;
            }
            if (mode == Mode::tangent && (!is_input(field.kind) || call.ports[f].dot)) {
                m.dots[f].reset(size_of(field) * directions);
                m.scene.dot[f] = m.dots[f].data;
            }
        }
        if (const int64_t threads = call.threads / tasks; threads > 1 && call.substeps >= LONG) {
            std::lock_guard<std::mutex> lock(program.guard);
            m.team = std::make_unique<Team>(threads, program.habits[int(mode)]);
            m.scene.team = m.team.get(), m.scene.worth = call.worth, m.scene.desks.resize(threads - 1);
        }
        for (Desk<R>& desk : m.scene.desks) {
            for (auto* at : {&desk.value, &desk.bar, &desk.dot}) at->assign(count, nullptr);
            for (auto* shares : {&desk.values, &desk.bars, &desk.dots}) shares->resize(count);
            desk.own_regs.reset(m.scene.regs.size), desk.own_bars.reset(m.scene.bars.size), desk.own_dots.reset(m.scene.dots.size);
        }
        m.scene.parts = program.parts(m.scene);
        return m;
    }
    void learn(const Memory& m, Mode mode) const {
        if (m.team == nullptr) return;
        std::lock_guard<std::mutex> lock(program.guard);
        program.habits[int(mode)] = m.team->habit;
    }

    struct Group {  // of directions that go together, some of the last one empty
        int64_t first;
        int size;
    };
    std::vector<Group> groups() const {
        std::vector<Group> out;
        for (int64_t first = 0; first < call.directions; first += out.back().size)
            out.push_back({first, call.directions - first > FEW ? MANY : FEW});
        return out;
    }

    // Between the caller's [rows, components] and ours, which has pitches; `depth` numbers each.
    void load(R* to, const Field& f, const void* from, int64_t at, int depth, int which = 0) const {
        if (from == nullptr) return;
        const R* source = static_cast<const R*>(from) + at;
        const size_t rows = outer(f) / f.comps;
        for (size_t r = 0; r < rows; r++)
            for (int c = 0; c < f.comps; c++) to[(f.place(r) + c) * depth + which] = source[r * f.comps + c];
    }
    void unload(void* to, int64_t at, const Field& f, const R* from, int depth, int which = 0) const {
        if (to == nullptr) return;
        R* target = static_cast<R*>(to) + at;
        const size_t rows = outer(f) / f.comps;
        for (size_t r = 0; r < rows; r++)
            for (int c = 0; c < f.comps; c++) target[r * f.comps + c] = from[(f.place(r) + c) * depth + which];
    }
    size_t outer(const Field& f) const {  // numbers of the caller's array for one scene
        return size_t(f.kind == Kind::drive ? call.substeps : f.rows) * f.comps;
    }

    void start(Memory& m, int64_t scene, R* row) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == Kind::state) load(row + field.offset, field, call.ports[f].value, scene * call.ports[f].stride, 1);
        }
    }
    // Results of a frame; sums begin anew.
    void finish(Memory& m, int64_t scene, const R* row, int64_t frame) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            const int64_t at = (scene * call.frames + frame) * outer(field);
            if (program.next[f] >= 0) unload(call.ports[program.next[f]].result, at, field, row + field.offset, 1);
            if (field.kind != Kind::sum) continue;
            unload(call.ports[f].result, at, field, m.scene.value[f], 1);
            m.values[f].clear();
        }
    }

    // Sets fields to zero, f(zero) with zero(field, numbers): every thread its own rows.
    template <class F>
    static void clear(Scene<R>& s, F f) {
        auto part = [&](int m) {
            f([&](R* field, size_t size) {
                const size_t lines = (size + LANES<R> - 1) / LANES<R>;
                std::fill(field + lines * m / s.parts * LANES<R>, field + std::min(size, lines * (m + 1) / s.parts * LANES<R>), R(0));
            });
        };
        if (s.parts == 1) part(0);
        else s.team->run(s.parts, part);
    }

    // Let every field point to where it is in substep k.
    void point(Memory& m, int64_t scene, int64_t k, R* row, R* after) const {
        m.scene.substep = k;
        if (m.scene.parts > 1) m.team->weigh();
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == Kind::state || field.kind == Kind::kept) m.scene.value[f] = row + field.offset;
            if (program.next[f] >= 0) m.scene.value[program.next[f]] = after + field.offset;
            if (field.kind == Kind::drive) {
                m.scene.value[f] = m.values[f].data + k * field.comps;
                if (m.bars[f].data) m.scene.bar[f] = m.bars[f].data + k * field.comps;
                if (m.dots[f].data) m.scene.dot[f] = m.dots[f].data + k * field.comps * m.scene.directions;
            }
        }
        clear(m.scene, [&](auto zero) {
            for (size_t f : m.temporaries) {
                zero(m.scene.value[f], program.fields[f].size());
                if (m.scene.dot[f]) zero(m.scene.dot[f], program.fields[f].size() * m.scene.directions);
            }
        });
    }
    void substep(Memory& m, int64_t scene, int64_t k, R* row, R* after) const {
        point(m, scene, k, row, after);
        for (const auto& stage : program.stages) stage->forward(m.scene);
    }
    void back(Memory& m, int64_t scene, int64_t k, R* row, R* after) const {
        m.scene.substep = k;
        if (m.scene.parts > 1) m.team->weigh();
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == Kind::state || field.kind == Kind::kept) m.scene.value[f] = row + field.offset;
            if (program.next[f] >= 0) m.scene.value[program.next[f]] = after + field.offset;
            if (field.kind == Kind::drive) {
                m.scene.value[f] = m.values[f].data + k * field.comps;
                if (m.bars[f].data) m.scene.bar[f] = m.bars[f].data + k * field.comps;
            }
        }
        clear(m.scene, [&](auto zero) {
            for (size_t f = 0; f < program.fields.size(); f++) {
                const Field& field = program.fields[f];
                if (field.kind == Kind::state || is_within(field.kind)) zero(m.scene.bar[f], field.size());
                if (field.kind == Kind::temporary) zero(m.scene.value[f], field.size());
            }
        });
        for (const auto& stage : program.stages) if (stage->again) stage->replay(m.scene);
        for (auto stage = program.stages.rbegin(); stage != program.stages.rend(); ++stage) (*stage)->reverse(m.scene);
        for (size_t f = 0; f < program.fields.size(); f++)
            if (program.next[f] >= 0) std::swap(m.scene.bar[f], m.scene.bar[program.next[f]]);
    }

    void seed(Memory& m, int64_t scene) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == Kind::next || field.kind == Kind::sum)
                load(m.scene.bar[f], field, call.ports[f].seed, scene * outer(field), 1);
        }
    }
    void gradients(Memory& m, int64_t scene) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            void* to = call.ports[f].gradient;
            if (is_input(field.kind)) unload(to, scene * outer(field), field, m.bars[f].data, 1);
            if (program.next[f] >= 0) unload(to, scene * outer(field), field, m.scene.bar[program.next[f]], 1);
        }
    }

    void load_dots(Memory& m, int64_t scene, const Group& group) const {
        each_dot(group, [&](size_t f, int64_t direction, int which) {
            const Field& field = program.fields[f];
            const Port& port = call.ports[f];
            if ((is_input(field.kind) || field.kind == Kind::state) && port.dot)
                load(m.dots[f].data, field, port.dot, scene * port.dot_stride + direction * outer(field), group.size, which);
        });
    }
    void save_dots(Memory& m, int64_t scene, const Group& group) const {
        each_dot(group, [&](size_t f, int64_t direction, int which) {
            const Field& field = program.fields[f];
            const int64_t at = (scene * call.directions + direction) * outer(field);
            if (program.next[f] >= 0) unload(call.ports[program.next[f]].dot_result, at, field, m.scene.dot[f], group.size, which);
            if (field.kind == Kind::sum) unload(call.ports[f].dot_result, at, field, m.scene.dot[f], group.size, which);
        });
    }
    template <class F>
    void each_dot(const Group& group, F work) const {
        const int64_t last = std::min(group.first + group.size, call.directions);
        for (int64_t direction = group.first; direction < last; direction++)
            for (size_t f = 0; f < program.fields.size(); f++) work(f, direction, int(direction - group.first));
    }
};

}  // namespace tc
