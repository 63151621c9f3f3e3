// How a solid body stops what approaches: torchcloth/boundaries/collider.py and friction.py. A loop calls place, the
// distance of the shape (shapes.cpp), inwards, the law of friction, outwards; what stands still needs no places.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Pose of a body, pose of the shape in it -> pose of the shape.
struct Compose {
    static constexpr const char* name = "compose";
    static constexpr int inputs = 32, outputs = 16;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        for (int i = 0; i < 4; i++)
            for (int j = 0; j < 4; j++) {
                const T *a = in + 4 * i, *b = in + 16 + j;
                out[4 * i + j] = a[0] * b[0] + a[1] * b[4] + a[2] * b[8] + a[3] * b[12];
            }
    }
};

// x, increment, pose, dt -> place in the shape's coordinates, velocity with which the body carries it along.
struct Place {
    static constexpr const char* name = "place";
    static constexpr int inputs = 36, outputs = 6;
    static constexpr auto fixed = bits(35, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x = r.vec();
        const auto step = r.pose();
        r.at += 4;
        const auto pose = r.pose();
        r.at += 4;
        const auto carried = step.R * x + step.t;
        Write<T> w{out};
        w.vec(transposed(pose.R, carried - pose.t)), w.vec((carried - x) / r.number());
    }
};

// Velocity, that of the body, pose -> slip in the shape's axes.
struct Inwards {
    static constexpr const char* name = "inwards";
    static constexpr int inputs = 22, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto v = r.vec(), own = r.vec();
        Write<T>{out}.vec(transposed(r.pose().R, v - own));
    }
};

// Vector in the shape's axes, pose -> in the world's.
struct Outwards {
    static constexpr const char* name = "outwards";
    static constexpr int inputs = 19, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto change = r.vec();
        Write<T>{out}.vec(r.pose().R * change);
    }
};

// mu
template <class T>
struct CoulombLaw {
    static constexpr const char* name = "coulomb";
    static constexpr int inputs = 1;
    T mu;
    constexpr CoulombLaw(const T* in) : mu(in[0]) {}
    constexpr T size(Vec<T> slip) const { return safe_norm(slip); }
    constexpr T coefficient(T) const { return mu; }
};

// mu of fast slip, excess at rest, speed
template <class T>
struct StribeckLaw : CoulombLaw<T> {
    static constexpr const char* name = "stribeck";
    static constexpr int inputs = 3;
    T excess, speed;
    constexpr StribeckLaw(const T* in) : CoulombLaw<T>(in), excess(in[1]), speed(in[2]) {}
    constexpr T coefficient(T size) const {
        const T share = size / speed;
        return this->mu + excess * exp(-(share * share));
    }
};

// mu along the axis, ratio of the mu across to it, axis
template <class T>
struct EllipticLaw : CoulombLaw<T> {
    static constexpr const char* name = "elliptic";
    static constexpr int inputs = 5;
    T ratio;
    Vec<T> axis;
    constexpr EllipticLaw(const T* in) : CoulombLaw<T>(in), ratio(in[1]), axis{in[2], in[3], in[4]} {}
    constexpr T size(Vec<T> slip) const {
        const auto across = slip - dot(slip, axis) * axis;
        return safe_norm(slip + (1.0 / ratio - 1.0) * across);
    }
};

// Slip, distance, normal, dt, offset, recovery, the law's numbers -> change of velocity, in the shape's axes.
template <template <class> class Law>
struct Response {
    static constexpr const char* name = Law<Sym>::name;
    static constexpr int inputs = 10 + Law<Sym>::inputs, outputs = 3;
    static constexpr auto fixed = bits(7, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto v = r.vec();
        const T distance = r.number();
        const auto normal = r.vec();
        const T dt = r.number(), offset = r.number(), recovery = r.number();
        const Law<T> law(r.at);
        const T wanted = (offset - distance) / dt;
        const T least = select(less(recovery, wanted), recovery, wanted);
        const T approach = dot(v, normal), push = at_least(least - approach, 0.0);
        const auto slip = v - approach * normal;
        const T size = law.size(slip), limit = law.coefficient(size) * push;
        const T sticks = less(0.0, limit) * (1.0 - less(limit, size));
        const T taken = select(sticks, 1.0, limit / select(less(0.0, size), size, 1.0));
        Write<T>{out}.vec(push * normal - taken * slip);
    }
};

}  // namespace

TC_KERNELS(collider_kernels, Compose, Place, Inwards, Outwards, Response<CoulombLaw>, Response<StribeckLaw>,
           Response<EllipticLaw>)

}  // namespace tc
