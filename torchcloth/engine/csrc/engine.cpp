// The engine's plain C interface. Programs are built once and run many times. Errors are returned as text.
#include <string>

#include "contact.h"
#include "kernels/kernels.h"
#include "surface_derivative_stencil.h"
#include "loop.h"
#include "nearest.h"
#include "grid_momentum_to_velocity.h"
#include "run.h"
#include "broad_phase.h"
#include "stencil.h"

namespace {

thread_local std::string message;

template <class F>
int guarded(F work) {
    try {
        work();
        return 0;
    } catch (const std::exception& error) {
        message = error.what();
        return 1;
    }
}

// Returns the number that the work returns; -1 when it fails.
template <class F>
int numbered(F work) {
    int number = -1;
    guarded([&] { number = work(); });
    return number;
}

template <class R>
struct Engine {
    tc::Program<R> program;
    const std::vector<tc::Kernel<R>>& kernels = tc::all_kernels<R>();

    tc::Loop<R>& loop() {
        auto* last = program.stages.empty() ? nullptr : dynamic_cast<tc::Loop<R>*>(program.stages.back().get());
        if (last == nullptr) throw std::logic_error("no loop to add to");
        return *last;
    }
    void stencil(int table, int weight, int x, int y, tc::StencilForm form) {
        if (!tc::SurfaceDerivatives<R>::fits(program, weight, y)) {
            program.stages.push_back(std::make_unique<tc::Stencil<R>>(program, table, weight, x, y, form));
            return;
        }
        std::shared_ptr<const tc::StencilAndTranspose<R>> links;
        for (const auto& stage : program.stages) {
            const auto* other = dynamic_cast<const tc::SurfaceDerivatives<R>*>(stage.get());
            if (other && other->weight == weight) links = other->links;
        }
        if (!links) links = std::make_shared<tc::StencilAndTranspose<R>>(program, table, weight);
        const bool transposed = form == tc::StencilForm::transposed;
        program.stages.push_back(std::make_unique<tc::SurfaceDerivatives<R>>(program, links, weight, x, y, transposed));
    }
};

}  // namespace

#define TC_API extern "C" __attribute__((visibility("default")))
// Every function exists for float (f) and double (d).
#define TC_BOTH(R, s)                                                                                                  \
    TC_API void* tc_new_##s() {                                                                                        \
        void* engine = nullptr;                                                                                        \
        guarded([&] { engine = new Engine<R>(); });                                                                    \
        return engine;                                                                                                 \
    }                                                                                                                  \
    TC_API void tc_free_##s(void* e) { delete static_cast<Engine<R>*>(e); }                                            \
    TC_API int tc_field_##s(void* e, int kind, int rows, int comps, int neighbours, int vertices, const R* data) {     \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return numbered([&] {                                                                                          \
            const int f = p.field(tc::FieldKind(kind), rows, comps, neighbours, vertices);                             \
            if (data) {                                                                                                \
                p.constants[f].reset(p.fields[f].size());                                                              \
                for (int r = 0; r < rows; r++)                                                                         \
                    for (int c = 0; c < comps; c++)                                                                    \
                        p.constants[f].data[p.fields[f].place(r) + c] = data[r * comps + c];                           \
            }                                                                                                          \
            return f;                                                                                                  \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_next_state_##s(void* e, int state, int next) {                                                       \
        return guarded([&] { static_cast<Engine<R>*>(e)->program.next.at(state) = next; });                            \
    }                                                                                                                  \
    TC_API int tc_table_##s(void* e, const int* data, int count) {                                                     \
        auto& tables = static_cast<Engine<R>*>(e)->program.tables;                                                     \
        return numbered([&] {                                                                                          \
            tables.emplace_back(data, data + count);                                                                   \
            tables.back().resize(tc::round_up(count, tc::LANES<float>), count ? data[count - 1] : 0);                  \
            return int(tables.size()) - 1;                                                                             \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_loop_##s(void* e, int items, int list, int contact_points, int no_derivative, int replayed) {        \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        auto& p = engine.program;                                                                                      \
        return guarded([&] {                                                                                           \
            p.stages.push_back(                                                                                        \
                std::make_unique<tc::Loop<R>>(p, engine.kernels.data(), items, list, contact_points,                   \
                                              no_derivative != 0));                                                    \
            p.stages.back()->is_replayed = replayed != 0;                                                              \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_transfer_##s(void* e, int code, int field, int table, int offset, int shares, int basis,             \
                               int is_needed) {                                                                        \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            engine.loop().code.push_back({tc::Opcode(code), field, table, -1, tc::NODE_NUMBERS, -1,                    \
                                          {offset, shares, basis}, {}, is_needed != 0});                               \
            engine.program.registers = std::max(engine.program.registers, shares + tc::TRANSFER_SHARES);               \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_contact_search_##s(void* e, const int* fields, int count, const int* corners, int triangles,         \
                              const double* places, int each, const double* lengths, const int* limits,                \
                              const int* order, const int* starts, const uint8_t* may_meet,                            \
                              const uint8_t* non_adjacent) {                                                           \
        auto& program = static_cast<Engine<R>*>(e)->program;                                                           \
        return guarded([&] {                                                                                           \
            auto contact = std::make_unique<tc::ContactSearch<R>>(program);                                            \
            contact->x = fields[0], contact->lowest_node = fields[1], contact->shift = fields[2],                      \
            contact->grid.assign(fields + 3, fields + count);                                                          \
            contact->spacing = R(lengths[0]), contact->skin = R(lengths[1]), contact->search_interval = limits[0];     \
            contact->place.assign(places, places + 3 * each);                                                          \
            if (limits[2] != tc::PATCH_TRIANGLES) throw std::logic_error("patches of another size");                   \
            contact->search.fill(corners, triangles, R(lengths[2]), limits[1], order, starts, may_meet, non_adjacent); \
            program.mask_words = (triangles + 31) / 32, program.contact_tables = tc::contact_table::count,             \
            program.contact_counts = tc::contact_count::count;                                                         \
            program.stages.push_back(std::move(contact));                                                              \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_grid_velocity_##s(void* e, int mass, int momentum, int velocity, double min_mass) {                  \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return guarded([&] {                                                                                           \
            p.stages.push_back(std::make_unique<tc::GridVelocity<R>>(mass, momentum, velocity, R(min_mass)));          \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_move_##s(void* e, int code, int field, int table, int reg) {                                         \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            const int comps = engine.program.fields.at(field).comps;                                                   \
            auto& loop = engine.loop();                                                                                \
            const auto opcode = tc::Opcode(code);                                                                      \
            loop.code.push_back(                                                                                       \
                {opcode, field, table, reg, comps, -1, {}, {}, false, loop.slot_of(table),                             \
                 engine.program.fields[field].kind == tc::FieldKind::points,                                           \
                 engine.program.fields[field].kind == tc::FieldKind::constant});                                       \
            if (opcode == tc::Opcode::load && loop.is_invariant(field, table))                                         \
                loop.code.back().invariant = engine.program.invariants++;                                              \
            engine.program.registers = std::max(engine.program.registers, reg + comps);                                \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_kernel_##s(void* e, int kernel, const int* in, const int* out, int is_needed) {                      \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            const auto& k = engine.kernels.at(kernel);                                                                 \
            engine.loop().code.push_back({tc::Opcode::call, -1, -1, -1, 0, kernel, {in, in + k.inputs},                \
                                          {out, out + k.outputs}, is_needed != 0});                                    \
            for (int o : engine.loop().code.back().out)                                                                \
                engine.program.registers = std::max(engine.program.registers, (o >= 0 ? o : ~o) + 1);                  \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_lookup_##s(void* e, int field, int x, int y, int z, int in, int out) {                               \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            engine.loop().code.push_back({tc::Opcode::lookup, field, -1, -1, 0, -1, {in, x, y, z}, {out}});            \
            engine.program.registers = std::max(engine.program.registers, out + tc::LOOKUP_REGISTERS);                 \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_broad_phase_##s(void* e, int list, int x, int approach, int dt, int corners, int starts,             \
                                  int triangles,                                                                       \
                             double lipschitz) {                                                                       \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return guarded([&] {                                                                                           \
            p.point_lists = std::max(p.point_lists, list + 1);                                                         \
            p.stages.push_back(                                                                                        \
                std::make_unique<tc::PointBroadPhase<R>>(p, list, x, approach, dt, corners, starts, triangles,         \
                                                         lipschitz));                                                  \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_stencil_##s(void* e, int table, int weight, int x, int y, int form) {                                \
        return guarded([&] { static_cast<Engine<R>*>(e)->stencil(table, weight, x, y, tc::StencilForm(form)); });      \
    }                                                                                                                  \
    TC_API int tc_lay_out_##s(void* e) {                                                                               \
        return guarded([&] { static_cast<Engine<R>*>(e)->program.lay_out(); });                                        \
    }                                                                                                                  \
    TC_API int64_t tc_record_size_##s(void* e, int full) {                                                             \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return int64_t(full ? p.record_size : p.state_size);                                                           \
    }                                                                                                                  \
    TC_API int64_t tc_records_size_##s(void* e, int64_t substeps, int64_t record_interval) {                           \
        return int64_t(tc::records_size(static_cast<Engine<R>*>(e)->program, substeps, record_interval));              \
    }                                                                                                                  \
    TC_API int tc_run_##s(void* e, const tc::RunCall* call, int mode) {                                                \
        return guarded([&] {                                                                                           \
            tc::Run<R> run(static_cast<Engine<R>*>(e)->program, *call);                                                \
            const auto run_mode = tc::RunMode(mode);                                                                   \
            if (run_mode == tc::RunMode::values) run.forward();                                                        \
            else if (run_mode == tc::RunMode::adjoints) run.reverse();                                                 \
            else run.tangent();                                                                                        \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_nearest_##s(const R* points, int64_t many, const R* corners, int64_t count, int64_t* face,           \
                               R* weights) {                                                                           \
        return guarded([&] { tc::nearest(points, many, corners, count, face, weights); });                             \
    }

TC_BOTH(float, f)
TC_BOTH(double, d)

TC_API const char* tc_error() { return message.c_str(); }
// The enumerations of enums.h as text, for engine/enums.py.
TC_API const char* tc_enums() { return tc::ENUMS; }
TC_API int tc_kernels() { return int(tc::all_kernels<double>().size()); }
TC_API const char* tc_kernel_name(int k) { return tc::all_kernels<double>()[k].name; }
TC_API int tc_kernel_info(int k, int what) {
    const auto& kernel = tc::all_kernels<double>()[k];
    return what == 0 ? kernel.inputs : what == 1 ? kernel.outputs : kernel.flops;
}
// Operations of a kernel: {TapeOp, first, second, third operand or -1, whether it has a derivative} each.
TC_API int tc_kernel_size(int k) { return tc::all_kernels<double>()[k].listing.size; }
TC_API void tc_kernel_listing(int k, int* operations, double* values, int* out) {
    const auto& kernel = tc::all_kernels<double>()[k];
    for (int i = 0; i < kernel.listing.size; i++) {
        const tc::Node& n = kernel.listing.nodes[i];
        for (int number : {int(n.op), n.a, n.b, n.c, int(kernel.listing.varies[i])}) *operations++ = number;
        *values++ = n.value;
    }
    for (int i = 0; i < kernel.outputs; i++) *out++ = kernel.listing.out[i];
}
