// Many substeps of many scenes: values with records, the reverse sweep from them, and tangents.
#pragma once

#include <algorithm>
#include <exception>
#include <mutex>

#include "scene_lanes.h"

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
    double min_filled_lanes;    // share of a pack's lanes that scenes fill; fewer scenes run one by one
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

    struct Group {  // scenes that run together, each in a lane, or a single one
        int64_t first;
        int count, lanes;  // lanes beyond the last scene repeat it
    };
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
        const std::vector<Group> groups = scene_groups();
        for_each_task(groups.size(), [&](int64_t task) {
            const Group& group = groups[task];
            Memory m = memory(group, RunMode::values, groups.size());
            const bool in_place = has_rows_in_records(group);
            for (int64_t scene = group.first; interval && scene < group.first + group.count; scene++)
                clear_record(scene, in_place ? 0 : record_count(call.substeps, interval) - 1);
            m.rows.reset(2 * row_size(group));
            R *row = in_place ? record(group.first, 0) : m.rows.data, *after = nullptr;
            load_state(m, group, row);
            int64_t frame = 0;
            for (int64_t k = 0; k < call.substeps; k++) {
                if (interval > 1 && k % interval == 0) save(group, k / interval, row, program.state_size);
                if (in_place) clear_record(group.first, k + 1);
                after = in_place ? record(group.first, k + 1) : other_row(m, group, row);
                substep(m, k, row, after);
                if (interval == 1 && !in_place) save(group, k, row, program.record_size);
                row = after;
                if (k + 1 == call.frame_ends[frame] && frame + 1 < call.frames) write_frame(m, group, row, frame++);
            }
            if (interval == 1 && !in_place) save(group, call.substeps, row, program.state_size);
            write_frame(m, group, row, frame);
            store_policy(m, RunMode::values);
        });
    }

    void reverse() {
        const std::vector<Group> groups = scene_groups();
        for_each_task(groups.size(), [&](int64_t task) {
            const Group& group = groups[task];
            Memory m = memory(group, RunMode::adjoints, groups.size());
            load_seeds(m, group);
            const bool in_place = has_rows_in_records(group);
            if (!in_place) m.rows.reset((interval + 1) * row_size(group));
            for (int64_t first = (call.substeps - 1) / interval * interval; first >= 0; first -= interval) {
                const int64_t last = std::min(first + interval, call.substeps);
                auto row = [&](int64_t k) {  // with records of all substeps, the two rows change places
                    return in_place        ? record(group.first, k)
                           : interval == 1 ? m.rows.data + k % 2 * row_size(group)
                                           : m.rows.data + (k - first) * row_size(group);
                };
                if (interval > 1) {
                    restore(group, first / interval, row(first), program.state_size);
                    for (int64_t k = first; k < last; k++) substep(m, k, row(k), row(k + 1));
                } else if (!in_place) {
                    if (last == call.substeps) restore(group, last, row(last), program.state_size);
                    restore(group, first, row(first), program.record_size);
                }
                for (int64_t k = last - 1; k >= first; k--) reverse_substep(m, k, row(k), row(k + 1));
            }
            store_gradients(m, group);
            store_policy(m, RunMode::adjoints);
        });
    }

    void tangent() {
        const std::vector<DirectionGroup> all = direction_groups();
        const int64_t count = int64_t(all.size());
        for_each_task(call.scenes * count, [&](int64_t task) {
            const Group group{task / count, 1, 1};  // directions share the lanes already
            const DirectionGroup& directions = all[task % count];
            Memory m = memory(group, RunMode::tangents, call.scenes * count, directions.size);
            load_tangents(m, group.first, directions);
            m.rows.reset(2 * program.record_size);
            R *row = m.rows.data, *after = nullptr;
            load_state(m, group, row);
            for (int64_t k = 0; k < call.substeps; k++) {
                after = other_row(m, group, row);
                begin_substep(m, k, row, after);
                for (const auto& stage : program.stages) stage->tangent(m.scene);
                for (size_t f = 0; f < program.fields.size(); f++)
                    if (program.next[f] >= 0) std::swap(m.scene.dot[f], m.scene.dot[program.next[f]]);
                row = after;
            }
            if (directions.first == 0) write_frame(m, group, row, 0);
            store_tangents(m, group.first, directions);
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
    // Whether substeps read and write the records themselves, and no copies.
    bool has_rows_in_records(const Group& group) const { return interval == 1 && group.lanes == 1; }
    // Numbers of a substep's fields that are recorded, for all scenes of a group.
    size_t row_size(const Group& group) const { return program.record_size * group.lanes; }
    R* other_row(const Memory& m, const Group& group, const R* row) const {
        return row == m.rows.data ? m.rows.data + row_size(group) : m.rows.data;
    }
    // Copies the first numbers of a row to record k of every scene, and back. Records do not know lanes.
    void save(const Group& group, int64_t k, const R* row, size_t size) const {
        if (group.lanes == 1) return void(std::memcpy(record(group.first, k), row, size * sizeof(R)));
        Wide<R> square[LANES<R>];
        for (size_t at = 0; at < size; at += LANES<R>) {
            std::memcpy(static_cast<void*>(square), row + at * LANES<R>, sizeof(square));
            transpose_square(square);
            for (int lane = 0; lane < group.count; lane++)
                std::memcpy(record(group.first + lane, k) + at, &square[lane], sizeof(Wide<R>));
        }
    }
    void restore(const Group& group, int64_t k, R* row, size_t size) const {
        if (group.lanes == 1) return void(std::memcpy(row, record(group.first, k), size * sizeof(R)));
        Wide<R> square[LANES<R>];
        for (size_t at = 0; at < size; at += LANES<R>) {
            for (int lane = 0; lane < group.lanes; lane++)
                std::memcpy(static_cast<void*>(&square[lane]), record(scene_of(group, lane), k) + at, sizeof(Wide<R>));
            transpose_square(square);
            std::memcpy(row + at * LANES<R>, square, sizeof(square));
        }
    }

    std::vector<Group> scene_groups() const {
        std::vector<Group> out;
        const bool uses_lanes = program.runs_in_lanes();
        for (int64_t first = 0; first < call.scenes; first += out.back().count) {
            const int64_t left = call.scenes - first;
            const int count = int(std::min<int64_t>(left, LANES<R>));
            if (uses_lanes && count >= call.min_filled_lanes * LANES<R>) out.push_back({first, count, LANES<R>});
            else out.push_back({first, 1, 1});
        }
        return out;
    }
    static int64_t scene_of(const Group& group, int lane) { return group.first + std::min(lane, group.count - 1); }

    static bool is_input(FieldKind kind) { return kind == FieldKind::parameter || kind == FieldKind::per_substep; }
    static bool is_within(FieldKind kind) { return kind == FieldKind::temporary || kind == FieldKind::recorded; }
    size_t size_of(const Field& f) const {
        return f.kind == FieldKind::per_substep ? size_t(call.substeps) * f.pitch : f.size();
    }

    // Memory of one of so many tasks, with tangents along so many directions.
    Memory memory(const Group& group, RunMode mode, int64_t tasks, int directions = 0) const {
        Memory m;
        m.scene.lanes = group.lanes;
        const size_t count = program.fields.size();
        m.scene.value.assign(count, nullptr), m.scene.bar.assign(count, nullptr), m.scene.dot.assign(count, nullptr);
        m.values.resize(count), m.bars.resize(count), m.dots.resize(count);
        m.scene.contact_counts.assign(program.contact_counts, 0),
            m.scene.contact_rows.assign(program.contact_tables, nullptr);
        m.scene.substeps = call.substeps, m.scene.has_masks = mode == RunMode::adjoints;
        if (interval)
            m.scene.masks = reinterpret_cast<int32_t*>(record(group.first, record_count(call.substeps, interval)));
        const size_t registers = size_t(program.registers) * (group.lanes > 1 ? ITEMS_IN_LANES : 1);
        m.scene.regs.reset(registers), m.scene.point_lists.resize(program.point_lists);
        m.scene.invariants.resize(program.invariants);
        if (mode == RunMode::adjoints) m.scene.bars.reset(registers);
        if (mode == RunMode::tangents) {
            m.scene.directions = directions;
            m.scene.dots.reset(registers * LANES<R> * directions);
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
                m.values[f].reset(size_of(field) * group.lanes);
                m.scene.value[f] = m.values[f].data;
            }
            if (is_input(field.kind)) load_scenes(group, m.values[f].data, field, call.ports[f]);
            if (mode == RunMode::adjoints && (!is_input(field.kind) || call.ports[f].gradient)) {
                m.bars[f].reset(size_of(field) * group.lanes);
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
    void load_scenes(const Group& group, R* to, const Field& f, const Port& port) const {
        for (int lane = 0; lane < group.lanes; lane++)
            load(to, f, port.value, scene_of(group, lane) * port.stride, group.lanes, lane);
    }
    size_t outer(const Field& f) const {  // numbers of the caller's array for one scene
        return size_t(f.kind == FieldKind::per_substep ? call.substeps : f.rows) * f.comps;
    }

    void load_state(Memory& m, const Group& group, R* row) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            if (field.kind == FieldKind::state)
                load_scenes(group, row + size_t(field.offset) * group.lanes, field, call.ports[f]);
        }
    }
    // Writes the results of a frame, and clears the sums.
    void write_frame(Memory& m, const Group& group, const R* row, int64_t frame) const {
        for (size_t f = 0; f < program.fields.size(); f++) {
            const Field& field = program.fields[f];
            for (int lane = 0; lane < group.count; lane++) {
                const int64_t at = ((group.first + lane) * call.frames + frame) * outer(field);
                if (program.next[f] >= 0)
                    unload(call.ports[program.next[f]].result, at, field, row + size_t(field.offset) * group.lanes,
                           group.lanes, lane);
                if (field.kind == FieldKind::sum)
                    unload(call.ports[f].result, at, field, m.scene.value[f], group.lanes, lane);
            }
            if (field.kind == FieldKind::sum) m.values[f].clear();
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
            const size_t place = size_t(field.offset) * m.scene.lanes;
            if (field.kind == FieldKind::state || field.kind == FieldKind::recorded) m.scene.value[f] = row + place;
            if (program.next[f] >= 0) m.scene.value[program.next[f]] = after + place;
            if (field.kind == FieldKind::per_substep) {
                const size_t first = size_t(k) * field.pitch * m.scene.lanes;
                m.scene.value[f] = m.values[f].data + first;
                if (m.bars[f].data) m.scene.bar[f] = m.bars[f].data + first;
                if (m.dots[f].data) m.scene.dot[f] = m.dots[f].data + first * m.scene.directions;
            }
        }
    }
    void begin_substep(Memory& m, int64_t k, R* row, R* after) const {
        point_to_substep(m, k, row, after);
        clear(m.scene, [&](auto zero) {
            for (size_t f : m.temporaries) {
                zero(m.scene.value[f], program.fields[f].size() * m.scene.lanes);
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
                const size_t size = field.size() * m.scene.lanes;
                if (field.kind == FieldKind::state || is_within(field.kind)) zero(m.scene.bar[f], size);
                if (field.kind == FieldKind::temporary) zero(m.scene.value[f], size);
            }
        });
        for (const auto& stage : program.stages) if (stage->is_replayed) stage->replay(m.scene);
        for (auto stage = program.stages.rbegin(); stage != program.stages.rend(); ++stage) (*stage)->reverse(m.scene);
        for (size_t f = 0; f < program.fields.size(); f++)
            if (program.next[f] >= 0) std::swap(m.scene.bar[f], m.scene.bar[program.next[f]]);
    }

    void load_seeds(Memory& m, const Group& group) const {
        for_each_scene(group, [&](size_t f, int64_t scene, int lane) {
            const Field& field = program.fields[f];
            if (field.kind == FieldKind::next || field.kind == FieldKind::sum)
                load(m.scene.bar[f], field, call.ports[f].seed, scene * outer(field), group.lanes, lane);
        });
    }
    void store_gradients(Memory& m, const Group& group) const {
        for_each_scene(group, [&](size_t f, int64_t scene, int lane) {
            const Field& field = program.fields[f];
            auto store = [&](const R* from) {
                unload(call.ports[f].gradient, scene * outer(field), field, from, group.lanes, lane);
            };
            if (is_input(field.kind)) store(m.bars[f].data);
            if (program.next[f] >= 0) store(m.scene.bar[program.next[f]]);
        });
    }
    // Calls work(field, scene, its lane).
    template <class F>
    void for_each_scene(const Group& group, F work) const {
        for (int lane = 0; lane < group.count; lane++)
            for (size_t f = 0; f < program.fields.size(); f++) work(f, group.first + lane, lane);
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
