// Velocities that obey the boundaries: torchcloth/boundaries.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Velocity of a grasped vertex, from the pose increment [4, 4], dt, whether the gripper is closed, and the vertex's
// position and velocity. boundaries/grasp.py
struct GraspVelocity {
    static constexpr const char* name = "grasp_velocity";
    static constexpr int inputs = 24, outputs = 3;
    static constexpr auto constant_inputs = input_bits(16, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto motion = r.pose();
        r.at += 4;
        const T dt = r.number(), closed = r.number();
        const auto x = r.vec(), v = r.vec();
        Writer<T>{out}.vec(select(closed, displacement(motion, x) / dt, v));
    }
};
TC_KERNEL(GraspVelocity)

// Difference of two vectors.
struct Subtract {
    static constexpr const char* name = "subtract3";
    static constexpr int inputs = 6, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto after = r.vec();
        Writer<T>{out}.vec(after - r.vec());
    }
};
TC_KERNEL(Subtract)

// Impulse and its moment about the body's origin at the start of the substep, from momentum, position, increment and
// pose. dynamics/forces.py
struct Impulse {
    static constexpr const char* name = "impulse";
    static constexpr int inputs = 38, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto momentum = r.vec(), x = r.vec();
        const auto step = r.pose();
        r.at += 4;
        const auto end = r.pose();
        const auto origin = transposed(step.R, end.t - step.t);
        Writer<T> w{out};
        w.vec(momentum), w.vec(cross(x - origin, momentum));
    }
};
TC_KERNEL(Impulse)

// Velocity of a vertex whose grip creeps, from its velocity, the pull on the grip patch, the patch's mass and added
// mass, mobility, holding force and dt. effects/grip_slip.py
template <bool ADDED_MASS>
struct GripCreepBy {
    static constexpr int inputs = ADDED_MASS ? 16 : 10, outputs = 3;
    static constexpr auto constant_inputs = input_bits(inputs - 1, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto v = r.vec(), pull = r.vec();
        T mass = r.number();
        const T size = safe_norm(pull);
        if constexpr (ADDED_MASS) {
            const auto direction = pull / select(less(0.0, size), size, 1.0);
            mass = mass + dot(direction, r.symmetric() * direction);
        }
        const T mobility = r.number(), hold = r.number(), dt = r.number();
        const T slips = less(hold * dt, size);
        const T excess = select(slips, 1.0 - hold * dt / select(slips, size, 1.0), 0.0);
        Writer<T>{out}.vec(v - (mobility * excess / (dt + mobility * mass)) * pull);
    }
};
struct GripCreep : GripCreepBy<false> { static constexpr const char* name = "grip_creep"; };
TC_KERNEL(GripCreep)
struct GripCreepAddedMass : GripCreepBy<true> { static constexpr const char* name = "grip_creep_added_mass"; };
TC_KERNEL(GripCreepAddedMass)

}  // namespace

}  // namespace tc
