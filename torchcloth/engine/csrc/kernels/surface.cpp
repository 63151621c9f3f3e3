// The substep itself, and the kinematics of a triangle.
#include "kernels.h"
#include "surface.h"

namespace tc {
namespace {

// A change of velocity as the added mass resists it, written such that zero added mass changes no bit.
// dynamics/forces.py
template <class T>
constexpr Vec<T> resist(Symmetric<T> air, T mass, Vec<T> change) {
    const auto b = air / mass;
    return change - solve(Symmetric<T>{b.xx + 1.0, b.xy, b.xz, b.yy + 1.0, b.yz, b.zz + 1.0}, b * change);
}

// Acceleration of force, mass and, if any, added mass.
template <bool ADDED_MASS, class T>
constexpr Vec<T> acceleration(Reader<T>& r) {
    const auto force = r.vec();
    const T mass = r.number();
    if constexpr (ADDED_MASS) return resist(r.symmetric(), mass, force / mass);
    else return force / mass;
}

// Velocity before the boundaries act, from dt, velocity, force, mass and added mass.
template <bool ADDED_MASS>
struct KickBy {
    static constexpr int inputs = ADDED_MASS ? 14 : 8, outputs = 3;
    static constexpr auto constant_inputs = input_bits(0, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T dt = r.number();
        const auto v = r.vec();
        Writer<T>{out}.vec(v + dt * acceleration<ADDED_MASS>(r));
    }
};
struct Kick : KickBy<false> { static constexpr const char* name = "kick"; };
TC_KERNEL(Kick)
struct KickAddedMass : KickBy<true> { static constexpr const char* name = "kick_added_mass"; };
TC_KERNEL(KickAddedMass)

// The next Chebyshev polynomial of velocities, from dt, w_0, w_1, count of grips, velocity, velocity before, viscous
// force, mass and added mass. dynamics/viscous_stages.py
template <bool ADDED_MASS>
struct ViscousStageBy {
    static constexpr int inputs = ADDED_MASS ? 20 : 14, outputs = 3;
    static constexpr auto constant_inputs = input_bits(0, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T dt = r.number(), first = r.number(), slope = r.number(), grips = r.number();
        const auto v = r.vec(), before = r.vec();
        const T factor = select(less(grips, 0.5), slope * dt, 0.0);
        Writer<T>{out}.vec(first * v + factor * acceleration<ADDED_MASS>(r) - before);
    }
};
struct ViscousStage : ViscousStageBy<false> { static constexpr const char* name = "viscous_stage"; };
TC_KERNEL(ViscousStage)
struct ViscousStageAddedMass : ViscousStageBy<true> { static constexpr const char* name = "viscous_stage_added_mass"; };
TC_KERNEL(ViscousStageAddedMass)

// Momentum that added mass and mass take with a change of velocity. dynamics/forces.py
struct MomentumAddedMass {
    static constexpr const char* name = "momentum_added_mass";
    static constexpr int inputs = 10, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto air = r.symmetric();
        const T mass = r.number();
        const auto change = r.vec();
        Writer<T>{out}.vec(mass * change + air * change);
    }
};
TC_KERNEL(MomentumAddedMass)

// A vector times a number.
struct Scale {
    static constexpr const char* name = "scale3";
    static constexpr int inputs = 4, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T scale = r.number();
        Writer<T>{out}.vec(scale * r.vec());
    }
};
TC_KERNEL(Scale)

// Sum of two vectors.
struct Add {
    static constexpr const char* name = "add3";
    static constexpr int inputs = 6, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto a = r.vec();
        Writer<T>{out}.vec(a + r.vec());
    }
};
TC_KERNEL(Add)

// Position after the substep, from dt, position and velocity.
struct Drift {
    static constexpr const char* name = "drift";
    static constexpr int inputs = 7, outputs = 3;
    static constexpr auto constant_inputs = input_bits(0, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T dt = r.number();
        const auto x = r.vec(), v = r.vec();
        Writer<T>{out}.vec(x + dt * v);
    }
};
TC_KERNEL(Drift)

// Position and compensation after the substep: compensated summation (Kahan 1965) of dt, position, velocity and
// compensation. Derivatives are those of the plain sum.
struct DriftCompensated {
    static constexpr const char* name = "drift_compensated";
    static constexpr int inputs = 10, outputs = 6;
    static constexpr auto constant_inputs = input_bits(0, 1) | input_bits(7, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T dt = r.number();
        const auto x = r.vec(), v = r.vec();
        const auto change = dt * v + r.vec();
        const auto after = x + change;
        Writer<T> w{out};
        w.vec(after), w.vec(change - (after - x));
    }
};
TC_KERNEL(DriftCompensated)

// Copies of numbers, which a loop may add to a register.
template <int N>
struct CopyOf {
    static constexpr int inputs = N, outputs = N;
    template <class T>
    static constexpr void run(const T* in, T* out) { for (int i = 0; i < N; i++) out[i] = 1.0 * in[i]; }
};
struct Copy : CopyOf<3> { static constexpr const char* name = "copy3"; };
TC_KERNEL(Copy)
struct CopyStress : CopyOf<15> { static constexpr const char* name = "copy15"; };
TC_KERNEL(CopyStress)

TC_KERNEL(Surface)
TC_KERNEL(CompensatedEdges)
TC_KERNEL(AssembleForces)

}  // namespace

}  // namespace tc
