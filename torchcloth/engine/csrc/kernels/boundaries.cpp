// What boundaries do to velocities: torchcloth/boundaries.
#include "kernels.h"
#include "../vec.h"

namespace tc {

// increment [4, 4], dt, position -> velocity of a held vertex. boundaries/grasp.py
struct Grasp {
    static constexpr const char* name = "grasp";
    static constexpr int inputs = 20, outputs = 3;
    static constexpr auto fixed = bits(16, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto motion = r.pose();
        r.at += 4;
        const T dt = r.number();
        const auto x = r.vec();
        const auto target = motion.R * x + motion.t;
        Write<T>{out}.vec((target - x) / dt);
    }
};

// mass, velocity before and after, position, increment, pose -> impulse and its moment about the body's origin at the
// start of the substep. dynamics.py
struct Impulse {
    static constexpr const char* name = "impulse";
    static constexpr int inputs = 42, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T mass = r.number();
        const auto before = r.vec(), after = r.vec(), x = r.vec();
        const auto step = r.pose();
        r.at += 4;
        const auto end = r.pose();
        const auto origin = transposed(step.R, end.t - step.t);
        const auto momentum = mass * (after - before);
        Write<T> w{out};
        w.vec(momentum), w.vec(cross(x - origin, momentum));
    }
};

TC_KERNELS(boundary_kernels, Grasp, Impulse)

}  // namespace tc
