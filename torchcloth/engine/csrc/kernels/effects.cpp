// Forces of effects: torchcloth/effects.
#include "kernels.h"
#include "../vec.h"

namespace tc {

// Positions and velocities of the corners, pressure, friction, wind -> forces on the corners. effects/air.py
struct AirDrag {
    static constexpr const char* name = "air_drag";
    static constexpr int inputs = 23, outputs = 9;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec(), a = r.vec(), b = r.vec(), c = r.vec();
        const T pressure = r.number(), friction = r.number();
        const auto relative = (1.0 / 3) * (a + b + c) - r.vec();
        const auto normal = cross(x1 - x0, x2 - x0);
        const T twice = sqrt(dot(normal, normal));  // the area
        const auto n = normal / twice;
        const T speed = dot(relative, n);
        const auto along = relative - speed * n;
        const T third = (1.0 / 6) * twice;  // of the area: each corner's part
        const auto part = -((pressure * third * abs(speed) * speed) * n) - (friction * third * safe_norm(along)) * along;
        Write<T> w{out};
        w.vec(part), w.vec(part), w.vec(part);
    }
};

// mass, acceleration -> force. effects/gravity.py
struct Weight {
    static constexpr const char* name = "weight";
    static constexpr int inputs = 4, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T mass = r.number();
        Write<T>{out}.vec(mass * r.vec());
    }
};

// rate, mass, velocity -> force. effects/damping.py
struct MassDamping {
    static constexpr const char* name = "mass_damping";
    static constexpr int inputs = 5, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T rate = r.number(), mass = r.number();
        Write<T>{out}.vec(-((rate * mass) * r.vec()));
    }
};

// stiffness, viscosity, x, v -> what the plate matrix acts on. effects/bending.py
struct Bent {
    static constexpr const char* name = "bent";
    static constexpr int inputs = 8, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T stiffness = r.number(), viscosity = r.number();
        const auto x = r.vec(), v = r.vec();
        Write<T>{out}.vec(stiffness * x + viscosity * v);
    }
};

TC_KERNELS(effect_kernels, AirDrag, Weight, MassDamping, Bent)

}  // namespace tc
