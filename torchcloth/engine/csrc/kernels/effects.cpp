// Forces of effects: torchcloth/effects.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Forces of air drag on the corners, from positions and velocities of the corners, half the air's density times C_n
// and C_t, and wind. effects/air.py: f = -1/2 rho a (C_n |u_n| u_n n + C_t |u_t| u_t), a third on each corner. With
// N = `normal` = 2 a n: u_n = u.N / |N|, and u_n n = (u.N / N.N) N = `flow_ratio` N. Thus a third of the force is
// -(across N + slide u_t) with across = rho C_n / 12 |u.N| u.N / N.N and slide = rho C_t / 12 |N| |u_t|.
struct AirDrag {
    static constexpr const char* name = "air_drag";
    static constexpr int inputs = 23, outputs = 9;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec(), a = r.vec(), b = r.vec(), c = r.vec();
        const T pressure = r.number(), friction = r.number();
        const auto relative = (1.0 / 3) * (a + b + c) - r.vec();
        const auto normal = cross(x1 - x0, x2 - x0);  // its length is twice the area
        const T squared = dot(normal, normal), flow = dot(relative, normal);
        const T flow_ratio = flow / squared;
        const auto along = relative - flow_ratio * normal;
        const T across = (1.0 / 6) * pressure * abs(flow) * flow_ratio;  // a third of the area belongs to each corner
        const T slide = (1.0 / 6) * friction * sqrt(squared) * safe_norm(along);
        const auto force = -(across * normal + slide * along);
        Writer<T> w{out};
        w.vec(force), w.vec(force), w.vec(force);
    }
};
TC_KERNEL(AirDrag)

// Forces of local drag on the corners, from positions and velocities of the corners, the linear and quadratic
// coefficients across and along the sheet, and the area. effects/residual.py
struct LocalDrag {
    static constexpr const char* name = "local_drag";
    static constexpr int inputs = 23, outputs = 9;
    static constexpr auto constant_inputs = input_bits(22, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec(), a = r.vec(), b = r.vec(), c = r.vec();
        const T across = r.number(), across2 = r.number(), along = r.number(), along2 = r.number(), area = r.number();
        const auto v = (1.0 / 3) * (a + b + c);
        const auto normal = cross(x1 - x0, x2 - x0);
        const auto n = (1.0 / sqrt(dot(normal, normal))) * normal;
        const T speed = dot(v, n);
        const auto tangential = v - speed * n;
        const T press = (across + across2 * abs(speed)) * speed, slide = along + along2 * safe_norm(tangential);
        const auto force = ((-1.0 / 3) * area) * (press * n + slide * tangential);
        Writer<T> w{out};
        w.vec(force), w.vec(force), w.vec(force);
    }
};
TC_KERNEL(LocalDrag)

// A corner's third of the added mass, which acts along the normal only, from mass per area, n and area.
// effects/added_mass.py
struct AddedMass {
    static constexpr const char* name = "added_mass";
    static constexpr int inputs = 5, outputs = 6;
    static constexpr auto constant_inputs = input_bits(4, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T air = r.number();
        const auto n = r.vec();
        Writer<T>{out}.symmetric(outer((1.0 / 3) * (air * r.number()), n));
    }
};
TC_KERNEL(AddedMass)

// Forces of the added mass on the corners as the normals turn, from cofactors, n, J, velocities of the corners, warp
// and weft coefficients, area and mass per area. effects/added_mass.py
struct AddedMassTurning {
    static constexpr const char* name = "added_mass_turning";
    static constexpr int inputs = 25, outputs = 9;
    static constexpr auto constant_inputs = input_bits(19, 5);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto c1 = r.vec(), c2 = r.vec(), n = r.vec();
        const T J = r.number();
        const auto v0 = r.vec(), v1 = r.vec(), v2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), area = r.number(), air = r.number();
        const auto d1 = v1 - v0, d2 = v2 - v0;
        const auto turning = dot(a1 * d1 + a2 * d2, n) * c1 + dot(b1 * d1 + b2 * d2, n) * c2;
        const auto share = ((1.0 / 3) * (air * area) / J) * n;
        Writer<T> w{out};
        w.vec(dot(v0, turning) * share), w.vec(dot(v1, turning) * share), w.vec(dot(v2, turning) * share);
    }
};
TC_KERNEL(AddedMassTurning)

// Force of a mass and an acceleration. effects/gravity.py
struct Weight {
    static constexpr const char* name = "weight";
    static constexpr int inputs = 4, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T mass = r.number();
        Writer<T>{out}.vec(mass * r.vec());
    }
};
TC_KERNEL(Weight)

// Damping force of rate, mass and velocity. effects/damping.py
struct MassDamping {
    static constexpr const char* name = "mass_damping";
    static constexpr int inputs = 5, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T rate = r.number(), mass = r.number();
        Writer<T>{out}.vec(-((rate * mass) * r.vec()));
    }
};
TC_KERNEL(MassDamping)

// Force of adhesion, from position, stress, area, a point of the plane, its normal and the gap. effects/adhesion.py
struct Adhesion {
    static constexpr const char* name = "adhesion";
    static constexpr int inputs = 12, outputs = 3;
    static constexpr auto constant_inputs = input_bits(4, 8);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto x = r.vec();
        const T stress = r.number(), area = r.number();
        const auto point = r.vec(), normal = r.vec();
        const T height = dot(x - point, normal) / r.number();
        const T u = select(less(height, 0.0), 0.0, select(less(1.0, height), 1.0, height));
        const T share = 1.0 - u * u;
        Writer<T>{out}.vec(-((stress * area) * (share * share)) * normal);
    }
};
TC_KERNEL(Adhesion)

// Columns of the viscous stress, from f1, f2, velocities of the corners, warp and weft coefficients and viscosity.
// effects/viscous.py
struct KelvinVoigt {
    static constexpr const char* name = "kelvin_voigt";
    static constexpr int inputs = 20, outputs = 6;
    static constexpr auto constant_inputs = input_bits(15, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec(), v0 = r.vec(), v1 = r.vec(), v2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), viscosity = r.number();
        const auto d1 = v1 - v0, d2 = v2 - v0;
        const auto rate1 = a1 * d1 + a2 * d2, rate2 = b1 * d1 + b2 * d2;
        const T e11 = viscosity * dot(f1, rate1), e22 = viscosity * dot(f2, rate2);
        const T e12 = viscosity * (0.5 * (dot(f1, rate2) + dot(f2, rate1)));
        Writer<T> w{out};
        w.vec(e11 * f1 + e12 * f2), w.vec(e12 * f1 + e22 * f2);
    }
};
TC_KERNEL(KelvinVoigt)

}  // namespace

}  // namespace tc
