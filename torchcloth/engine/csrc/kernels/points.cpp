// Sample points on triangles that touch a body: torchcloth/boundaries/points.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Value at a point, from the values at the corners and the barycentric weights.
struct PointValue {
    static constexpr const char* name = "point_value";
    static constexpr int inputs = 12, outputs = 3;
    static constexpr auto constant_inputs = input_bits(9, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto a = r.vec(), b = r.vec(), c = r.vec();
        Writer<T>{out}.vec(r.at[0] * a + r.at[1] * b + r.at[2] * c);
    }
};
TC_KERNEL(PointValue)

// Distance to where a vertex touches and relative speed, from distance, offset, recovery, velocity and the body's
// velocity.
struct Approach {
    static constexpr const char* name = "approach";
    static constexpr int inputs = 9, outputs = 2;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T distance = r.number(), offset = r.number();
        r.number();
        const auto v = r.vec();
        Writer<T> w{out};
        w.number(distance - offset), w.number(safe_norm(v - r.vec()));
    }
};
TC_KERNEL(Approach)

// 1 if a point touches: demanded changes of velocity below 1e-6 m/s are rounding.
template <class T>
constexpr T touches(Vec<T> change) { return less(1e-12, dot(change, change)); }

// Fractions of the corners' masses that a point claims, from its demanded change of velocity and its weights.
struct ClaimMass {
    static constexpr const char* name = "claim_mass";
    static constexpr int inputs = 6, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        const T touching = touches(Reader<T>{in}.vec());
        for (int k = 0; k < 3; k++) out[k] = touching * in[3 + k];
    }
};
TC_KERNEL(ClaimMass)

// Weights over the masses of the corners.
struct WeightPerMass {
    static constexpr const char* name = "weight_per_mass";
    static constexpr int inputs = 6, outputs = 3;
    static constexpr auto constant_inputs = input_bits(0, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        for (int k = 0; k < 3; k++) out[k] = in[k] / in[3 + k];
    }
};
TC_KERNEL(WeightPerMass)

// Changes of the corners' velocities, from the demanded change, the weights over masses and the claims on the corners.
struct DistributeImpulse {
    static constexpr const char* name = "distribute_impulse";
    static constexpr int inputs = 9, outputs = 9;
    static constexpr auto constant_inputs = input_bits(6, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto change = r.vec(), weight = r.vec(), load = r.vec();
        const T touching = touches(change);
        const auto impulse = (touching / select(touching, dot(weight, load), 1.0)) * change;
        Writer<T> w{out};
        w.vec(weight.x * impulse), w.vec(weight.y * impulse), w.vec(weight.z * impulse);
    }
};
TC_KERNEL(DistributeImpulse)

}  // namespace

}  // namespace tc
