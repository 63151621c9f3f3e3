// Many substeps of many scenes: values with records, the reverse sweep from them, and tangents.
#pragma once

#include <algorithm>
#include <exception>
#include <mutex>

#include "program.h"

namespace tc {

// Memory of the caller for one field: [scenes, rows, components], or [scenes, substeps, components] for inputs per
// substep, or [scenes, frames, rows, components] for results of values. Tangents have the directions after the scenes.
// Null: not given, or not wanted.
struct Port {
    const void* value;       // of parameters, states, inputs per substep
    int64_t stride;          // numbers between scenes; 0: all share one
    void* result;            // of states after the substeps, and sums
    const void* seed;        // their adjoint
    void* gradient;          // of parameters, states, inputs per substep
    const void* tangent;     // likewise: [scenes or 1, directions, ...]
    int64_t tangent_stride;  // numbers between scenes; 0: all share one
    void* result_tangent;    // of states after the substeps, and sums
};

struct RunCall {
    const Port* ports;  // by field
    int64_t scenes, substeps, directions, threads;
    void* records;              // [scenes, records_size]
    int64_t record_interval;    // substeps between records; 0: no records
    double min_ops_per_thread;  // operations of a substep that make another thread worth while
    const int64_t* frame_ends;  // of values: substeps after which there are results
    int64_t frames;             // count of these
};

// Records of a scene before the active triangles.
inline int64_t record_count(int64_t substeps, int64_t interval) { return 1 + (substeps + interval - 1) / interval; }

// Numbers for one scene: [record_count, record_size or, where the interval is > 1, state_size], then the active
// triangles of contact as integers [substeps, words].
template <class R>
size_t records_size(const Program<R>& p, int64_t substeps, int64_t interval) {
    if (interval == 0) return 0;
    const size_t masks = (size_t(substeps) * p.mask_words * sizeof(int32_t) + sizeof(R) - 1) / sizeof(R);
    const size_t rows = size_t(record_count(substeps, interval)) * (interval == 1 ? p.record_size : p.state_size);
    return (rows + masks + LANES<R> - 1) / LANES<R> * LANES<R>;  // the next scene's records begin on a cache line
}

template <class R>
class Run {
    static constexpr int64_t MIN_SUBSTEPS_FOR_THREADS = 4;  // that are worth the start of a second thread
    const Program<R>& program;
    const RunCall& call;
    const int64_t interval;  // substeps between records

    struct Memory {
        std::unique_ptr<ThreadTeam> team;
        Scene<R> scene;
        std::vector<Buffer<R>> values, bars, dots;  // by field
        std::vector<size_t> temporaries;            // fields that are zero when a substep begins
        Buffer<R> rows;                             // records that the caller does not get
    };

  public:
    Run(const Program<R>& p, const RunCall& c) : program(p), call(c), interval(c.record_interval) {}

    void forward() {
        for_each_task(call.scenes, [&](int64_t scene) {
            Memory m = memory(scene, RunMode::values, call.scenes);
            R* first = interval ? record(scene, 0) : nullptr;
            if (interval) clear_record(scene, interval == 1 ? 0 : record_count(call.substeps, interval) - 1);
            m.rows.reset(2 * program.record_size);
            R *row = interval == 1 ? first : m.rows.data, *after = nullptr;
            load_state(m, scene, row);
            int64_t frame = 0;
            for (int64_t k = 0; k < call.substeps; k++) {
                if (interval > 1 && k % interval == 0) save(record(scene, k / interval), row);
                if (interval == 1) clear_record(scene, k + 1);
                after = interval == 1 ? record(scene, k + 1) : other_row(m, row);
                substep(m, k, row, after);
                row = after;
                if (k + 1 == call.frame_ends[frame] && frame + 1 < call.frames) write_frame(m, scene, row, frame++);
            }
            write_frame(m, scene, row, frame);
            store_policy(m, RunMode::values);
        });
    }

    void reverse() {
        for_each_task(call.scenes, [&](int64_t scene) {
            Memory m = memory(scene, RunMode::adjoints, call.scenes);
            load_seeds(m, scene);
            if (interval > 1) m.rows.reset((interval + 1) * program.record_size);
            for (int64_t first = (call.substeps - 1) / interval * interval; first >= 0; first -= interval) {
                const int64_t last = std::min(first + interval, call.substeps);
                auto row = [&](int64_t k) {
                    return interval == 1 ? record(scene, k) : m.rows.data + (k - first) * program.record_size;
                };
                if (interval > 1) {
                    std::memcpy(row(first), record(scene, first / interval), program.state_size * sizeof(R));
                    for (int64_t k = first; k < last; k++) substep(m, k, row(k), row(k + 1));
                }
                for (int64_t k = last - 1; k >= first; k--) reverse_substep(m, k, row(k), row(k + 1));
            }
            store_gradients(m, scene);
            store_policy(m, RunMode::adjoints);
        });
    }

    void tangent() {
        const std::vector<DirectionGroup> all = direction_groups();
        const int64_t count = int64_t(all.size());
        for_each_task(call.scenes * count, [&](int64_t task) {
            const int64_t scene = task / count;
            const DirectionGroup& group = all[task % count];
            Memory m = memory(scene, RunMode::tangents, call.scenes * count, group.size);
            load_tangents(m, scene, group);
            m.rows.reset(2 * program.record_size);
            R *row = m.rows.data, *after = nullptr;
            load_state(m, scene, row);
            for (int64_t k = 0; k < call.substeps; k++) {
                after = other_row(m, row);
                begin_substep(m, k, row, after);
                for (const auto& stage : program.stages) stage->tangent(m.scene);
                for (size_t f = 0; f < program.fields.size(); f++)
                    if (program.next[f] >= 0) std::swap(m.scene.dot[f], m.scene.dot[program.next[f]]);
                row = after;
            }
            if (group.first == 0) write_frame(m, scene, row, 0);
            store_tangents(m, scene, group);
            store_policy(m, RunMode::tangents);
        });
    }

  private:
    template <class F>
    void for_each_task(int64_t tasks, F work) {
        const int64_t workers = std::max<int64_t>(1, std::min(call.threads, tasks));
        const CoreReservation cores{int(workers)};
        std::atomic<int64_t> next{0};
        std::exception_ptr failure;
        std::mutex mutex;
        auto loop = [&] {
            [[maybe_unused]] const FlushDenormals flush;
            try {
                for (int64_t task; (task = next++) < tasks;) work(task);
            } catch (...) {
                std::lock_guard<std::mutex> lock(mutex);
                failure = std::current_exception();
            }
        };
        std::vector<std::thread> threads;
        try {
            threads.reserve(workers - 1);
            for (int64_t i = 1; i < workers; i++) threads.emplace_back(loop);
        } catch (const std::exception&) {  // the system gives no more threads; those that exist do all tasks
        }
        loop();
        for (auto& thread : threads) thread.join();
        if (failure) std::rethrow_exception(failure);
    }

    R* record(int64_t scene, int64_t k) const {
        const size_t size = interval == 1 ? program.record_size : program.state_size;
        return static_cast<R*>(call.records) + scene * records_size(program, call.substeps, interval) + k * size;
    }
    // Clears what no substep writes: lanes beyond the last row, and the last record or its end. Records are then the
    // same in every run.
    void clear_record(int64_t scene, int64_t k) const {
        const size_t size = k == call.substeps && interval == 1 ? program.record_size : program.state_size;
        std::memset(static_cast<void*>(record(scene, k)), 0, size * sizeof(R));
    }
    R* other_row(const Memory& m, const R* row) const {
        return row == m.rows.data ? m.rows.data + program.record_size : m.rows.data;
    }
    void save(R* to, const R* row) const { std::memcpy(to, row, program.state_size * sizeof(R)); }

    static bool is_input(FieldKind kind) { return kind == FieldKind::parameter || kind == FieldKind::per_substep; }
    static bool is_within(FieldKind kind) { return kind == FieldKind::temporary || kind == FieldKind::recorded; }
    size_t size_of(const Field& f) const {
        return f.kind == FieldKind::per_substep ? size_t(call.substeps) * f.comps : f.size();
    }

    // Memory of one of so many tasks, with tangents along so many directions.
    Memory memory(int64_t scene, RunMode mode, int64_t tasks, int directions = 0) const {
        Memory m;
        const size_t count = program.fields.size();
        m.scene.value.assign(count, nullptr), m.scene.bar.assign(count, nullptr), m.scene.dot.assign(count, nullptr);
        m.values.resize(count), m.bars.resize(count), m.dots.resize(count);
        m.scene.contact_counts.assign(program.contact_counts, 0),
            m.scene.contact_rows.assign(program.contact_tables, nullptr);
        m.scene.substeps = call.substeps, m.scene.has_masks = mode == RunMode::adjoints;
        if (interval) m.scene.masks = reinterpret_cast<int32_t*>(record(scene, record_count(call.substeps, interval)));
        m.scene.regs.reset(program.registers), m.scene.point_lists.resize(program.point_lists);
        m.scene.invariants.resize(program.invariants);
        if (mode == RunMode::adjoints) m.scene.bars.reset(program.registers);
        if (mode == RunMode::tangents) {
            m.scene.directions = directions;
            m.scene.dots.reset(size_t(program.registers) * LANES<R> * directions);
        }
        for (size_t f = 0; f < count; f++) {
            const Field& field = program.fields[f];
            if (field.kind == FieldKind::constant) {
                m.scene.value[f] = program.constants[f].data;
                continue;
            }
            if (field.kind == FieldKind::nodes || field.kind == FieldKind::points) continue;
            if (is_within(field.kind)) m.temporaries.push_back(f);
            if (field.kind == FieldKind::temporary || field.kind == FieldKind::sum || is_input(field.kind)) {
                m.values[f].reset(size_of(field));
                m.scene.value[f] = m.values[f].data;
            }
            if (is_input(field.kind))
                load(m.values[f].data, field, call.ports[f].value, scene * call.ports[f].stride, 1);
            if (mode == RunMode::adjoints && (!is_input(field.kind) || call.ports[f].gradient)) {
                m.bars[f].reset(size_of(field));
                m.scene.bar[f] = m.bars[f].data;
            }
            if (mode == RunMode::tangents && (!is_input(field.kind) || call.ports[f].tangent)) {
                m.dots[f].reset(size_of(field) * directions);
                m.scene.dot[f] = m.dots[f].data;
            }
        }
        if (const int64_t threads = call.threads / tasks; threads > 1 && call.substeps >= MIN_SUBSTEPS_FOR_THREADS) {
            std::lock_guard<std::mutex> lock(program.policy_mutex);
            m.team = std::make_unique<ThreadTeam>(threads, program.policies[int(mode)]);
            m.scene.team = m.team.get(), m.scene.min_ops_per_thread = call.min_ops_per_thread;
            m.scene.scratch.resize(threads - 1);
        }
        for (ThreadScratch<R>& t : m.scene.scratch) {
            for (auto* at : {&t.value, &t.bar, &t.dot}) at->assign(count, nullptr);
            for (auto* accumulators : {&t.values, &t.bars, &t.dots}) accumulators->resize(count);
            t.regs_memory.reset(m.scene.regs.size), t.bars_memory.reset(m.scene.bars.size);
            t.dots_memory.reset(m.scene.dots.size);
        }
        m.scene.parts = program.parts(m.scene);
        return m;
    }
    void store_policy(const Memory& m, RunMode mode) const {
        if (m.team == nullptr) return;
        std::lock_guard<std::mutex> lock(program.policy_mutex);
        program.policies[int(mode)] = m.team->policy;
    }

    struct DirectionGroup {  // directions of one pass; some of the last group are unused
        int64_t first;
        int size;
    };
    std::vector<DirectionGroup> direction_groups() const {
        std::vector<DirectionGroup> out;
        for (int64_t first = 0; first < call.directions; first += out.back().size)
            out.push_back({first, call.directions - first > NARROW_DIRECTIONS ? WIDE_DIRECTIONS : NARROW_DIRECTIONS});
        return out;
    }

    // Copies between the caller's [rows, components] and a field with pitches, whose elements have `depth` numbers
    // each.
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
        return size_t(f.kind == FieldKind::per_substep ? call.substeps : f.rows) * f.comps;
    }

    void load_state(Memory& m, int64_t scene, R* row) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == FieldKind::state)
                load(row + field.offset, field, call.ports[f].value, scene * call.ports[f].stride, 1);
        }
    }
    // Writes the results of a frame, and clears the sums.
    void write_frame(Memory& m, int64_t scene, const R* row, int64_t frame) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            const int64_t at = (scene * call.frames + frame) * outer(field);
            if (program.next[f] >= 0) unload(call.ports[program.next[f]].result, at, field, row + field.offset, 1);
            if (field.kind != FieldKind::sum) continue;
            unload(call.ports[f].result, at, field, m.scene.value[f], 1);
            m.values[f].clear();
        }
    }

    // Calls f(zero), which sets fields to zero by zero(field, numbers); every thread clears its rows.
    template <class F>
    static void clear(Scene<R>& s, F f) {
        auto part = [&](int m) {
            f([&](R* field, size_t size) {
                const size_t lines = (size + LANES<R> - 1) / LANES<R>;
                std::fill(field + lines * m / s.parts * LANES<R>,
                          field + std::min(size, lines * (m + 1) / s.parts * LANES<R>), R(0));
            });
        };
        if (s.parts == 1) part(0);
        else s.team->run(s.parts, part);
    }

    // Lets every field point to its place in substep k.
    void point_to_substep(Memory& m, int64_t k, R* row, R* after) const {
        m.scene.substep = k;
        if (m.scene.parts > 1) m.team->update_policy();
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == FieldKind::state || field.kind == FieldKind::recorded)
                m.scene.value[f] = row + field.offset;
            if (program.next[f] >= 0) m.scene.value[program.next[f]] = after + field.offset;
            if (field.kind == FieldKind::per_substep) {
                m.scene.value[f] = m.values[f].data + k * field.comps;
                if (m.bars[f].data) m.scene.bar[f] = m.bars[f].data + k * field.comps;
                if (m.dots[f].data) m.scene.dot[f] = m.dots[f].data + k * field.comps * m.scene.directions;
            }
        }
    }
    void begin_substep(Memory& m, int64_t k, R* row, R* after) const {
        point_to_substep(m, k, row, after);
        clear(m.scene, [&](auto zero) {
            for (size_t f : m.temporaries) {
                zero(m.scene.value[f], program.fields[f].size());
                if (m.scene.dot[f]) zero(m.scene.dot[f], program.fields[f].size() * m.scene.directions);
            }
        });
    }
    void substep(Memory& m, int64_t k, R* row, R* after) const {
        begin_substep(m, k, row, after);
        for (const auto& stage : program.stages) stage->forward(m.scene);
    }
    void reverse_substep(Memory& m, int64_t k, R* row, R* after) const {
        point_to_substep(m, k, row, after);
        clear(m.scene, [&](auto zero) {
            for (size_t f = 0; f < program.fields.size(); f++) {
                const Field& field = program.fields[f];
                if (field.kind == FieldKind::state || is_within(field.kind)) zero(m.scene.bar[f], field.size());
                if (field.kind == FieldKind::temporary) zero(m.scene.value[f], field.size());
            }
        });
        for (const auto& stage : program.stages) if (stage->is_replayed) stage->replay(m.scene);
        for (auto stage = program.stages.rbegin(); stage != program.stages.rend(); ++stage) (*stage)->reverse(m.scene);
        for (size_t f = 0; f < program.fields.size(); f++)
            if (program.next[f] >= 0) std::swap(m.scene.bar[f], m.scene.bar[program.next[f]]);
    }

    void load_seeds(Memory& m, int64_t scene) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == FieldKind::next || field.kind == FieldKind::sum)
                load(m.scene.bar[f], field, call.ports[f].seed, scene * outer(field), 1);
        }
    }
    void store_gradients(Memory& m, int64_t scene) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            void* to = call.ports[f].gradient;
            if (is_input(field.kind)) unload(to, scene * outer(field), field, m.bars[f].data, 1);
            if (program.next[f] >= 0) unload(to, scene * outer(field), field, m.scene.bar[program.next[f]], 1);
        }
    }

    void load_tangents(Memory& m, int64_t scene, const DirectionGroup& group) const {
        for_each_tangent(group, [&](size_t f, int64_t direction, int which) {
            const Field& field = program.fields[f];
            const Port& port = call.ports[f];
            if ((is_input(field.kind) || field.kind == FieldKind::state) && port.tangent)
                load(m.dots[f].data, field, port.tangent, scene * port.tangent_stride + direction * outer(field),
                     group.size, which);
        });
    }
    void store_tangents(Memory& m, int64_t scene, const DirectionGroup& group) const {
        for_each_tangent(group, [&](size_t f, int64_t direction, int which) {
            const Field& field = program.fields[f];
            const int64_t at = (scene * call.directions + direction) * outer(field);
            const size_t result = program.next[f] >= 0 ? program.next[f] : f;
            if (program.next[f] >= 0 || field.kind == FieldKind::sum)
                unload(call.ports[result].result_tangent, at, field, m.scene.dot[f], group.size, which);
        });
    }
    template <class F>
    void for_each_tangent(const DirectionGroup& group, F work) const {
        const int64_t last = std::min(group.first + group.size, call.directions);
        for (int64_t direction = group.first; direction < last; direction++)
            for (size_t f = 0; f < program.fields.size(); f++) work(f, direction, int(direction - group.first));
    }
};

}  // namespace tc
