// The engine's plain C interface. Programs are built once and run many times; errors come back as text.
#include <string>

#include "contact.h"
#include "kernels/kernels.h"
#include "derivatives.h"
#include "loop.h"
#include "nearest.h"
#include "per_mass.h"
#include "run.h"
#include "sieve.h"
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

// The number that the work gives; -1 when it fails.
template <class F>
int numbered(F work) {
    int number = -1;
    guarded([&] { number = work(); });
    return number;
}

template <class R>
struct Engine {
    tc::Program<R> program;
    std::vector<tc::Kernel<R>> kernels = tc::all_kernels<R>();

    tc::Loop<R>& loop() {
        auto* last = program.stages.empty() ? nullptr : dynamic_cast<tc::Loop<R>*>(program.stages.back().get());
        if (last == nullptr) throw std::logic_error("no loop to add to");
        return *last;
    }
    void stencil(int table, int weight, int x, int y, tc::Shape shape) {
        if (!tc::Derivatives<R>::fits(program, weight, y)) {
            program.stages.push_back(std::make_unique<tc::Stencil<R>>(program, table, weight, x, y, shape));
            return;
        }
        std::shared_ptr<const tc::BothWays<R>> links;
        for (const auto& stage : program.stages) {
            const auto* other = dynamic_cast<const tc::Derivatives<R>*>(stage.get());
            if (other && other->weight == weight) links = other->links;
        }
        if (!links) links = std::make_shared<tc::BothWays<R>>(program, table, weight);
        const bool transposed = shape == tc::Shape::transposed;
        program.stages.push_back(std::make_unique<tc::Derivatives<R>>(program, links, weight, x, y, transposed));
    }
};

}  // namespace

#define TC_API extern "C" __attribute__((visibility("default")))
// Every function exists for float (f) and double (d).
#define TC_BOTH(R, s)                                                                                                  \
    TC_API void* tc_new_##s() {                                                                                        \
        void* made = nullptr;                                                                                          \
        guarded([&] { made = new Engine<R>(); });                                                                      \
        return made;                                                                                                   \
    }                                                                                                                  \
    TC_API void tc_free_##s(void* e) { delete static_cast<Engine<R>*>(e); }                                            \
    TC_API int tc_field_##s(void* e, int kind, int rows, int comps, int near, int vertices, const R* data) {           \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return numbered([&] {                                                                                          \
            const int f = p.field(tc::Kind(kind), rows, comps, near, vertices);                                        \
            if (data) {                                                                                                \
                p.constants[f].reset(p.fields[f].size());                                                              \
                for (int r = 0; r < rows; r++)                                                                         \
                    for (int c = 0; c < comps; c++)                                                                    \
                        p.constants[f].data[p.fields[f].place(r) + c] = data[r * comps + c];                           \
            }                                                                                                          \
            return f;                                                                                                  \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_pair_##s(void* e, int state, int next) {                                                             \
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
    TC_API int tc_loop_##s(void* e, int items, int list, int counted, int flat, int again) {                           \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        auto& p = engine.program;                                                                                      \
        return guarded([&] {                                                                                           \
            p.stages.push_back(                                                                                        \
                std::make_unique<tc::Loop<R>>(p, engine.kernels.data(), items, list, counted, flat != 0));             \
            p.stages.back()->again = again != 0;                                                                       \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_transfer_##s(void* e, int code, int field, int table, int offset, int share, int by, int feeds) {    \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            engine.loop().code.push_back({tc::Instruction::Code(code), field, table, -1, tc::ON_NODE, -1,              \
                                          {offset, share, by}, {}, feeds != 0});                                       \
            engine.program.registers = std::max(engine.program.registers, share + tc::SHARES);                         \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_contact_##s(void* e, const int* fields, int count, const int* corners, int triangles,                \
                              const double* places, int each, const double* lengths, const int* limits,                \
                              const int* order, const int* starts, const uint8_t* meet, const uint8_t* apart) {        \
        auto& program = static_cast<Engine<R>*>(e)->program;                                                           \
        return guarded([&] {                                                                                           \
            auto contact = std::make_unique<tc::Contact<R>>(program);                                                  \
            contact->x = fields[0], contact->base = fields[1], contact->grid.assign(fields + 2, fields + count);       \
            contact->spacing = R(lengths[0]), contact->skin = R(lengths[1]), contact->chunk = limits[0];               \
            contact->place.assign(places, places + 3 * each);                                                          \
            if (limits[2] != tc::Search<R>::MOST) throw std::logic_error("patches of another size: stages.py");        \
            contact->search.fill(corners, triangles, R(lengths[2]), limits[1], order, starts, meet, apart);            \
            program.words = (triangles + 31) / 32, program.rows = tc::LISTS, program.counts = tc::COUNTS;              \
            program.stages.push_back(std::move(contact));                                                              \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_per_mass_##s(void* e, int mass, int given, int out, double least) {                                  \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return guarded([&] { p.stages.push_back(std::make_unique<tc::PerMass<R>>(mass, given, out, R(least))); });     \
    }                                                                                                                  \
    TC_API int tc_move_##s(void* e, int code, int field, int table, int reg) {                                         \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            const int comps = engine.program.fields.at(field).comps;                                                   \
            auto& loop = engine.loop();                                                                                \
            loop.code.push_back(                                                                                       \
                {tc::Instruction::Code(code), field, table, reg, comps, -1, {}, {}, false, loop.slot(table),           \
                 engine.program.fields[field].kind == tc::Kind::points});                                              \
            if (code == tc::Instruction::load && loop.is_fixed(field, table))                                          \
                loop.code.back().fixed = engine.program.fixed++;                                                       \
            engine.program.registers = std::max(engine.program.registers, reg + comps);                                \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_call_##s(void* e, int kernel, const int* in, const int* out, int feeds) {                            \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            const auto& k = engine.kernels.at(kernel);                                                                 \
            engine.loop().code.push_back({tc::Instruction::call, -1, -1, -1, 0, kernel, {in, in + k.inputs},           \
                                          {out, out + k.outputs}, feeds != 0});                                        \
            for (int o : engine.loop().code.back().out)                                                                \
                engine.program.registers = std::max(engine.program.registers, (o >= 0 ? o : ~o) + 1);                  \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_lookup_##s(void* e, int field, int x, int y, int z, int in, int out) {                               \
        auto& engine = *static_cast<Engine<R>*>(e);                                                                    \
        return guarded([&] {                                                                                           \
            engine.loop().code.push_back({tc::Instruction::lookup, field, -1, -1, 0, -1, {in, x, y, z}, {out}});       \
            engine.program.registers = std::max(engine.program.registers, out + tc::CELL);                             \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_sieve_##s(void* e, int list, int x, int reach, int dt, int corners, int starts, int triangles,       \
                             double steep) {                                                                           \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return guarded([&] {                                                                                           \
            p.lists = std::max(p.lists, list + 1);                                                                     \
            p.stages.push_back(                                                                                        \
                std::make_unique<tc::Sieve<R>>(p, list, x, reach, dt, corners, starts, triangles, steep));             \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_stencil_##s(void* e, int table, int weight, int x, int y, int shape) {                               \
        return guarded([&] { static_cast<Engine<R>*>(e)->stencil(table, weight, x, y, tc::Shape(shape)); });           \
    }                                                                                                                  \
    TC_API int tc_ready_##s(void* e) {                                                                                 \
        return guarded([&] { static_cast<Engine<R>*>(e)->program.lay_out(); });                                        \
    }                                                                                                                  \
    TC_API int64_t tc_size_##s(void* e, int full) {                                                                    \
        auto& p = static_cast<Engine<R>*>(e)->program;                                                                 \
        return int64_t(full ? p.record_size : p.state_size);                                                           \
    }                                                                                                                  \
    TC_API int64_t tc_records_##s(void* e, int64_t substeps, int64_t every) {                                          \
        return int64_t(tc::records_size(static_cast<Engine<R>*>(e)->program, substeps, every));                        \
    }                                                                                                                  \
    TC_API int tc_run_##s(void* e, const tc::Call* call, int mode) {                                                   \
        return guarded([&] {                                                                                           \
            tc::Run<R> run(static_cast<Engine<R>*>(e)->program, *call);                                                \
            mode == 0 ? run.forward() : mode == 1 ? run.reverse() : run.tangent();                                     \
        });                                                                                                            \
    }                                                                                                                  \
    TC_API int tc_nearest_##s(const R* points, int64_t many, const R* corners, int64_t count, int64_t* face,           \
                               R* weights) {                                                                           \
        return guarded([&] { tc::nearest(points, many, corners, count, face, weights); });                             \
    }

TC_BOTH(float, f)
TC_BOTH(double, d)

TC_API const char* tc_error() { return message.c_str(); }
TC_API int tc_kernels() { return int(tc::all_kernels<double>().size()); }
TC_API const char* tc_kernel_name(int k) { return tc::all_kernels<double>()[k].name; }
TC_API int tc_kernel_info(int k, int what) {
    const auto kernel = tc::all_kernels<double>()[k];
    return what == 0 ? kernel.inputs : what == 1 ? kernel.outputs : kernel.flops;
}
// Operation i of a kernel: {code as in tape.h, first, second, third operand or -1, whether it has a derivative}.
TC_API int tc_kernel_size(int k) { return tc::all_kernels<double>()[k].listing.size; }
TC_API void tc_kernel_listing(int k, int* operations, double* values, int* out) {
    const auto kernel = tc::all_kernels<double>()[k];
    for (int i = 0; i < kernel.listing.size; i++) {
        const tc::Node& n = kernel.listing.nodes[i];
        for (int number : {int(n.op), n.a, n.b, n.c, int(kernel.listing.varies[i])}) *operations++ = number;
        *values++ = n.value;
    }
    for (int i = 0; i < kernel.outputs; i++) *out++ = kernel.listing.out[i];
}
