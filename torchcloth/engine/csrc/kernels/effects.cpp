// Forces of effects: torchcloth/effects.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

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
        const auto normal = cross(x1 - x0, x2 - x0);  // twice the area long
        const T squared = dot(normal, normal), flow = dot(relative, normal);
        const T share = flow / squared;
        const auto along = relative - share * normal;
        const T across = (1.0 / 6) * pressure * abs(flow) * share;  // a third of the area for each corner
        const T slide = (1.0 / 6) * friction * sqrt(squared) * safe_norm(along);
        const auto part = -(across * normal + slide * along);
        Write<T> w{out};
        w.vec(part), w.vec(part), w.vec(part);
    }
};

// Positions and velocities of the corners; across, across2, along, along2; area -> forces on the corners.
// effects/residual.py
struct LocalDrag {
    static constexpr const char* name = "local_drag";
    static constexpr int inputs = 23, outputs = 9;
    static constexpr auto fixed = bits(22, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec(), a = r.vec(), b = r.vec(), c = r.vec();
        const T across = r.number(), across2 = r.number(), along = r.number(), along2 = r.number(), area = r.number();
        const auto v = (1.0 / 3) * (a + b + c);
        const auto normal = cross(x1 - x0, x2 - x0);
        const auto n = (1.0 / sqrt(dot(normal, normal))) * normal;
        const T speed = dot(v, n);
        const auto beside = v - speed * n;
        const T press = (across + across2 * abs(speed)) * speed, slide = along + along2 * safe_norm(beside);
        const auto part = ((-1.0 / 3) * area) * (press * n + slide * beside);
        Write<T> w{out};
        w.vec(part), w.vec(part), w.vec(part);
    }
};

// Mass of the air per area, n, area -> a corner's third of it, along the normal only. effects/added_mass.py
struct AddedMass {
    static constexpr const char* name = "added_mass";
    static constexpr int inputs = 5, outputs = 6;
    static constexpr auto fixed = bits(4, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T air = r.number();
        const auto n = r.vec();
        Write<T>{out}.symmetric(outer((1.0 / 3) * (air * r.number()), n));
    }
};

// cofactors, n, J, velocities of the corners, warp and weft coefficients, area, mass of the air per area -> forces on
// the corners, of the air as normals turn. effects/added_mass.py
struct TurningAir {
    static constexpr const char* name = "turning_air";
    static constexpr int inputs = 25, outputs = 9;
    static constexpr auto fixed = bits(19, 5);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto c1 = r.vec(), c2 = r.vec(), n = r.vec();
        const T J = r.number();
        const auto v0 = r.vec(), v1 = r.vec(), v2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), area = r.number(), air = r.number();
        const auto d1 = v1 - v0, d2 = v2 - v0;
        const auto turning = dot(a1 * d1 + a2 * d2, n) * c1 + dot(b1 * d1 + b2 * d2, n) * c2;
        const auto share = ((1.0 / 3) * (air * area) / J) * n;
        Write<T> w{out};
        w.vec(dot(v0, turning) * share), w.vec(dot(v1, turning) * share), w.vec(dot(v2, turning) * share);
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

// position, stress, area, a point of the plane, its normal, gap -> force. effects/adhesion.py
struct Adhesion {
    static constexpr const char* name = "adhesion";
    static constexpr int inputs = 12, outputs = 3;
    static constexpr auto fixed = bits(4, 8);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x = r.vec();
        const T stress = r.number(), area = r.number();
        const auto point = r.vec(), normal = r.vec();
        const T height = dot(x - point, normal) / r.number();
        const T u = select(less(height, 0.0), 0.0, select(less(1.0, height), 1.0, height));
        const T share = 1.0 - u * u;
        Write<T>{out}.vec(-((stress * area) * (share * share)) * normal);
    }
};

// f1, f2, corners' velocities, warp and weft coefficients, viscosity -> stress columns. effects/viscous.py
struct KelvinVoigt {
    static constexpr const char* name = "kelvin_voigt";
    static constexpr int inputs = 20, outputs = 6;
    static constexpr auto fixed = bits(15, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec(), v0 = r.vec(), v1 = r.vec(), v2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), viscosity = r.number();
        const auto d1 = v1 - v0, d2 = v2 - v0;
        const auto rate1 = a1 * d1 + a2 * d2, rate2 = b1 * d1 + b2 * d2;
        const T e11 = viscosity * dot(f1, rate1), e22 = viscosity * dot(f2, rate2);
        const T e12 = viscosity * (0.5 * (dot(f1, rate2) + dot(f2, rate1)));
        Write<T> w{out};
        w.vec(e11 * f1 + e12 * f2), w.vec(e12 * f1 + e22 * f2);
    }
};

}  // namespace

TC_KERNELS(effect_kernels, AirDrag, LocalDrag, AddedMass, TurningAir, Weight, MassDamping, Adhesion, KelvinVoigt)

}  // namespace tc
