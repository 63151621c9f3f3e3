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
        const auto way = displacement(step, x);
        Write<T> w{out};
        w.vec(transposed(pose.R, x + way - pose.t)), w.vec(way / r.number());
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

// Mass of the air that moves along, own mass -> the first over the second. dynamics.py
struct PerOwn {
    static constexpr const char* name = "per_own";
    static constexpr int inputs = 7, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto air = r.symmetric();
        Write<T>{out}.symmetric(air / r.number());
    }
};

// A symmetric tensor, pose -> the tensor in the shape's axes.
struct TensorInwards {
    static constexpr const char* name = "tensor_inwards";
    static constexpr int inputs = 22, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto b = r.symmetric();
        const auto R = r.pose().R;
        const Vec<T> x{R.a.x, R.b.x, R.c.x}, y{R.a.y, R.b.y, R.c.y}, z{R.a.z, R.b.z, R.c.z};
        const auto bx = b * x, by = b * y, bz = b * z;
        Write<T>{out}.symmetric({dot(x, bx), dot(x, by), dot(x, bz), dot(y, by), dot(y, bz), dot(z, bz)});
    }
};

// mu
template <class T>
struct CoulombLaw {
    static constexpr const char *name = "coulomb", *in_air = "coulomb_in_air";
    static constexpr int inputs = 1;
    T mu;
    constexpr CoulombLaw(const T* in) : mu(in[0]) {}
    constexpr T size(Vec<T> slip) const { return safe_norm(slip); }
    constexpr T coefficient(T) const { return mu; }
};

// mu of fast slip, excess at rest, speed
template <class T>
struct StribeckLaw : CoulombLaw<T> {
    static constexpr const char *name = "stribeck", *in_air = "stribeck_in_air";
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
    static constexpr const char *name = "elliptic", *in_air = "elliptic_in_air";
    static constexpr int inputs = 5;
    T ratio;
    Vec<T> axis;
    constexpr EllipticLaw(const T* in) : CoulombLaw<T>(in), ratio(in[1]), axis{in[2], in[3], in[4]} {}
    constexpr T size(Vec<T> slip) const {
        const auto across = slip - dot(slip, axis) * axis;
        return safe_norm(slip + (1.0 / ratio - 1.0) * across);
    }
};

// Slip, distance, normal, dt, offset, recovery, the law's numbers, mass of the air that moves along over the own ->
// change of velocity, in the shape's axes.
template <template <class> class Law, bool AIR>
struct Response {
    static constexpr const char* name = AIR ? Law<Sym>::in_air : Law<Sym>::name;
    static constexpr int inputs = 10 + Law<Sym>::inputs + (AIR ? 6 : 0), outputs = 3;
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
        const auto free = v - approach * normal;
        if constexpr (AIR) {
            const auto air = Read<T>{r.at + Law<T>::inputs}.symmetric();
            const auto held = air * normal;
            const auto withheld = solve(Symmetric<T>{1.0 + air.xx, air.xy, air.xz, 1.0 + air.yy, air.yz, 1.0 + air.zz}, held);
            const T along = dot(withheld, normal), given = push / (1.0 - along);
            const auto aside = given * (along * normal - withheld), slip = free + aside;
            const T squared = dot(slip, slip);
            const T inert = 1.0 + dot(slip, air * slip) / select(less(0.0, squared), squared, 1.0);
            Write<T>{out}.vec(push * normal + aside - taken(law, slip, given / inert) * slip);
        } else {
            Write<T>{out}.vec(push * normal - taken(law, free, push) * free);
        }
    }
    template <class T>
    static constexpr T taken(Law<T> law, Vec<T> slip, T push) {
        const T size = law.size(slip), limit = law.coefficient(size) * push;
        const T sticks = less(0.0, limit) * (1.0 - less(limit, size));
        return select(sticks, 1.0, limit / select(less(0.0, size), size, 1.0));
    }
};
template <template <class> class Law>
using Bare = Response<Law, false>;
template <template <class> class Law>
using InAir = Response<Law, true>;

}  // namespace

TC_KERNELS(collider_kernels, Compose, Place, Inwards, Outwards, PerOwn, TensorInwards, Bare<CoulombLaw>,
           Bare<StribeckLaw>, Bare<EllipticLaw>, InAir<CoulombLaw>, InAir<StribeckLaw>, InAir<EllipticLaw>)

}  // namespace tc
