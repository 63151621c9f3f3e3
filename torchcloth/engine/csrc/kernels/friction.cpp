// Friction between the yarns: torchcloth/effects/_dahl.py and friction.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Share z / Z after the strain has gone by path = change / threshold: share exp(-|path|) + path (1 - exp(-|path|)) / |path|.
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

// Curvature now, curvature and share before, threshold, moment HB -> curvature, share, moment z.
struct BendingFriction {
    static constexpr const char* name = "bending_friction";
    static constexpr int inputs = 11, outputs = 9;
    static constexpr auto fixed = bits(9, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto now = r.vec(), before = r.vec(), share = r.vec();
        const T threshold = r.number(), moment = r.number();
        const auto path = (now - before) / threshold;
        const Dahl<T> dahl(safe_norm(path));
        const auto after = dahl.keep * share + dahl.pull * path;
        Write<T> w{out};
        w.vec(now), w.vec(after), w.vec(moment * after);
    }
};

// f1, f2, cofactors, n, J, angle and share before, threshold, stress HG -> angle, share, stress columns.
struct ShearFriction {
    static constexpr const char* name = "shear_friction";
    static constexpr int inputs = 20, outputs = 8;
    static constexpr auto fixed = bits(18, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec(), c1 = r.vec(), c2 = r.vec();
        r.at += 3;
        const T J = r.number(), before = r.number(), share = r.number(), threshold = r.number(), stress = r.number();
        const T sine = dot(f1, f2), angle = atan2(sine, J);
        const T path = (angle - before) / threshold;
        const Dahl<T> dahl(safe_sqrt(path * path));
        const T after = dahl.keep * share + dahl.pull * path;
        const T scale = stress * after / (sine * sine + J * J);
        Write<T> w{out};
        w.number(angle), w.number(after);
        w.vec(scale * (J * f2 - sine * c1)), w.vec(scale * (J * f1 - sine * c2));
    }
};

}  // namespace

TC_KERNELS(friction_kernels, BendingFriction, ShearFriction)

}  // namespace tc
