// Friction between the yarns: torchcloth/effects/_dahl.py and friction.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Dahl's law: the friction z / Z after a change of strain by path = change / threshold is
// z / Z exp(-|path|) + path (1 - exp(-|path|)) / |path|.
template <class T>
struct Dahl {
    T keep, pull;
    constexpr explicit Dahl(T length) : keep(length), pull(length) {
        const T decay = expm1(-length);
        const T small = less(length, 1e-4), safe = select(small, 1.0, length);
        keep = decay + 1.0;
        pull = select(small, 1.0 - 0.5 * length + (1.0 / 6) * (length * length), -(decay / safe));
    }
};

// Curvature, friction z / Z and moment after the substep, from curvature, curvature and z / Z before, threshold and the
// largest moment.
struct BendingFriction {
    static constexpr const char* name = "bending_friction";
    static constexpr int inputs = 11, outputs = 9;
    static constexpr auto constant_inputs = input_bits(9, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto now = r.vec(), before = r.vec(), share = r.vec();
        const T threshold = r.number(), moment = r.number();
        const auto path = (now - before) / threshold;
        const Dahl<T> dahl(safe_norm(path));
        const auto after = dahl.keep * share + dahl.pull * path;
        Writer<T> w{out};
        w.vec(now), w.vec(after), w.vec(moment * after);
    }
};
TC_KERNEL(BendingFriction)

// Shear angle, friction z / Z and stress columns after the substep, from f1, f2, cofactors, n, J, angle and z / Z
// before, threshold and the largest stress.
struct ShearFriction {
    static constexpr const char* name = "shear_friction";
    static constexpr int inputs = 20, outputs = 8;
    static constexpr auto constant_inputs = input_bits(18, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec(), c1 = r.vec(), c2 = r.vec();
        r.at += 3;
        const T J = r.number(), before = r.number(), share = r.number(), threshold = r.number(), stress = r.number();
        const T sine = dot(f1, f2), angle = atan2(sine, J);
        const T path = (angle - before) / threshold;
        const Dahl<T> dahl(safe_sqrt(path * path));
        const T after = dahl.keep * share + dahl.pull * path;
        const T scale = stress * after / (sine * sine + J * J);
        Writer<T> w{out};
        w.number(angle), w.number(after);
        w.vec(scale * (J * f2 - sine * c1)), w.vec(scale * (J * f1 - sine * c2));
    }
};
TC_KERNEL(ShearFriction)

}  // namespace

}  // namespace tc
