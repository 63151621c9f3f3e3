// Contact points on triangles: torchcloth/boundaries/points.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Values at the corners, weights -> value at the point.
struct AtPoint {
    static constexpr const char* name = "at_point";
    static constexpr int inputs = 12, outputs = 3;
    static constexpr auto fixed = bits(9, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto a = r.vec(), b = r.vec(), c = r.vec();
        Write<T>{out}.vec(r.at[0] * a + r.at[1] * b + r.at[2] * c);
    }
};

// Distance, offset, recovery, velocity, that of the body -> distance to where it touches, speed.
struct Reach {
    static constexpr const char* name = "reach";
    static constexpr int inputs = 9, outputs = 2;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T distance = r.number(), offset = r.number();
        r.number();
        const auto v = r.vec();
        Write<T> w{out};
        w.number(distance - offset), w.number(safe_norm(v - r.vec()));
    }
};

// Wanted changes of velocity below 1e-6 m/s are rounding.
template <class T>
constexpr T touches(Vec<T> change) { return less(1e-12, dot(change, change)); }

// Wanted change at the point, weights -> how much of the corners' mass the point claims.
struct Claim {
    static constexpr const char* name = "claim";
    static constexpr int inputs = 6, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        const T touching = touches(Read<T>{in}.vec());
        for (int k = 0; k < 3; k++) out[k] = touching * in[3 + k];
    }
};

// Weights, masses of the corners -> the first over the second.
struct Light {
    static constexpr const char* name = "light";
    static constexpr int inputs = 6, outputs = 3;
    static constexpr auto fixed = bits(0, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        for (int k = 0; k < 3; k++) out[k] = in[k] / in[3 + k];
    }
};

// Wanted change, weights over the corners' masses, claims on the corners -> changes of the corners.
struct Shared {
    static constexpr const char* name = "shared";
    static constexpr int inputs = 9, outputs = 9;
    static constexpr auto fixed = bits(6, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto change = r.vec(), weight = r.vec(), load = r.vec();
        const T touching = touches(change);
        const auto impulse = (touching / select(touching, dot(weight, load), 1.0)) * change;
        Write<T> w{out};
        w.vec(weight.x * impulse), w.vec(weight.y * impulse), w.vec(weight.z * impulse);
    }
};

}  // namespace

TC_KERNELS(point_kernels, AtPoint, Reach, Claim, Light, Shared)

}  // namespace tc
