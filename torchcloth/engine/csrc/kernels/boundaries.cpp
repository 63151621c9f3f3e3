// What boundaries do to velocities: torchcloth/boundaries.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// increment [4, 4], dt, whether the gripper is closed, position and velocity of a held vertex -> its velocity.
// boundaries/grasp.py
struct Grasp {
    static constexpr const char* name = "grasp";
    static constexpr int inputs = 24, outputs = 3;
    static constexpr auto fixed = bits(16, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto motion = r.pose();
        r.at += 4;
        const T dt = r.number(), closed = r.number();
        const auto x = r.vec(), v = r.vec();
        Write<T>{out}.vec(select(closed, displacement(motion, x) / dt, v));
    }
};

// Velocity after and before -> its change.
struct Change {
    static constexpr const char* name = "change";
    static constexpr int inputs = 6, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto after = r.vec();
        Write<T>{out}.vec(after - r.vec());
    }
};

// Momentum, position, increment, pose -> impulse and its moment about the body's origin at the start of the substep.
// dynamics.py
struct Impulse {
    static constexpr const char* name = "impulse";
    static constexpr int inputs = 38, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto momentum = r.vec(), x = r.vec();
        const auto step = r.pose();
        r.at += 4;
        const auto end = r.pose();
        const auto origin = transposed(step.R, end.t - step.t);
        Write<T> w{out};
        w.vec(momentum), w.vec(cross(x - origin, momentum));
    }
};

// Velocity of a held vertex, pull and mass(es) of the patch, mobility, hold, dt -> velocity. effects/grip_slip.py
template <bool AIR>
struct Creeping {
    static constexpr int inputs = AIR ? 16 : 10, outputs = 3;
    static constexpr auto fixed = bits(inputs - 1, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto v = r.vec(), pull = r.vec();
        T mass = r.number();
        const T size = safe_norm(pull);
        if constexpr (AIR) {
            const auto way = pull / select(less(0.0, size), size, 1.0);
            mass = mass + dot(way, r.symmetric() * way);
        }
        const T mobility = r.number(), hold = r.number(), dt = r.number();
        const T slips = less(hold * dt, size);
        const T excess = select(slips, 1.0 - hold * dt / select(slips, size, 1.0), 0.0);
        Write<T>{out}.vec(v - (mobility * excess / (dt + mobility * mass)) * pull);
    }
};
struct Creep : Creeping<false> { static constexpr const char* name = "creep"; };
struct CreepInAir : Creeping<true> { static constexpr const char* name = "creep_in_air"; };

}  // namespace

TC_KERNELS(boundary_kernels, Grasp, Change, Impulse, Creep, CreepInAir)

}  // namespace tc
