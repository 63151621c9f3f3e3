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
        const auto target = motion.R * x + motion.t;
        Write<T>{out}.vec(select(closed, (target - x) / dt, v));
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

// Mass, velocity free and held of a held vertex -> what the gripper gives it, mass of the patch. effects/grip_slip.py
struct Pull {
    static constexpr const char* name = "pull";
    static constexpr int inputs = 7, outputs = 4;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T mass = r.number();
        const auto before = r.vec(), after = r.vec();
        Write<T> w{out};
        w.vec(mass * (after - before)), w.number(1.0 * mass);
    }
};

// Velocity of a held vertex, pull and mass of the patch, mobility, hold, dt -> velocity. effects/grip_slip.py
struct Creep {
    static constexpr const char* name = "creep";
    static constexpr int inputs = 10, outputs = 3;
    static constexpr auto fixed = bits(9, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto v = r.vec(), pull = r.vec();
        const T mass = r.number(), mobility = r.number(), hold = r.number(), dt = r.number();
        const T size = safe_norm(pull), slips = less(hold * dt, size);
        const T excess = select(slips, 1.0 - hold * dt / select(slips, size, 1.0), 0.0);
        Write<T>{out}.vec(v - (mobility * excess / (dt + mobility * mass)) * pull);
    }
};

}  // namespace

TC_KERNELS(boundary_kernels, Grasp, Change, Impulse, Pull, Creep)

}  // namespace tc
