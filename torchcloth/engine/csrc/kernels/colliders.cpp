// Response of a solid body to cloth that approaches: torchcloth/boundaries/collider.py and friction.py. A loop calls
// to_body_frame, the distance of the shape (shapes.cpp), velocity_to_body, the law of friction and rotate_to_world. A
// body that stands still needs only the distance and the law.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Pose of a shape, from the pose of its body and its pose in the body.
struct ComposePoses {
    static constexpr const char* name = "compose_poses";
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
TC_KERNEL(ComposePoses)

// Place in the shape's coordinates and velocity of the body there, from x, increment, pose and dt.
struct ToBodyFrame {
    static constexpr const char* name = "to_body_frame";
    static constexpr int inputs = 36, outputs = 6;
    static constexpr auto constant_inputs = input_bits(35, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto x = r.vec();
        const auto step = r.pose();
        r.at += 4;
        const auto pose = r.pose();
        r.at += 4;
        const auto shift = displacement(step, x);
        Writer<T> w{out};
        w.vec(transposed(pose.R, x + shift - pose.t)), w.vec(shift / r.number());
    }
};
TC_KERNEL(ToBodyFrame)

// Slip in the shape's axes, from velocity, velocity of the body and pose.
struct VelocityToBody {
    static constexpr const char* name = "velocity_to_body";
    static constexpr int inputs = 22, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto v = r.vec(), body = r.vec();
        Writer<T>{out}.vec(transposed(r.pose().R, v - body));
    }
};
TC_KERNEL(VelocityToBody)

// A vector in the world's axes, from the vector in the shape's axes and the pose.
struct RotateToWorld {
    static constexpr const char* name = "rotate_to_world";
    static constexpr int inputs = 19, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto change = r.vec();
        Writer<T>{out}.vec(r.pose().R * change);
    }
};
TC_KERNEL(RotateToWorld)

// Added mass over own mass. dynamics/forces.py
struct AddedMassRatio {
    static constexpr const char* name = "added_mass_ratio";
    static constexpr int inputs = 7, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto air = r.symmetric();
        Writer<T>{out}.symmetric(air / r.number());
    }
};
TC_KERNEL(AddedMassRatio)

// A symmetric tensor in the shape's axes, from the tensor and the pose.
struct TensorToBody {
    static constexpr const char* name = "tensor_to_body";
    static constexpr int inputs = 22, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto b = r.symmetric();
        const auto R = r.pose().R;
        const Vec<T> x{R.a.x, R.b.x, R.c.x}, y{R.a.y, R.b.y, R.c.y}, z{R.a.z, R.b.z, R.c.z};
        const auto bx = b * x, by = b * y, bz = b * z;
        Writer<T>{out}.symmetric({dot(x, bx), dot(x, by), dot(x, bz), dot(y, by), dot(y, bz), dot(z, bz)});
    }
};
TC_KERNEL(TensorToBody)

// Coefficient mu.
template <class T>
struct CoulombLaw {
    static constexpr const char *name = "coulomb", *with_added_mass = "coulomb_added_mass";
    static constexpr int inputs = 1;
    T mu;
    constexpr CoulombLaw(const T* in) : mu(in[0]) {}
    constexpr T size(Vec<T> slip) const { return safe_norm(slip); }
    constexpr T coefficient(T) const { return mu; }
};

// mu of fast slip, excess at rest, speed.
template <class T>
struct StribeckLaw : CoulombLaw<T> {
    static constexpr const char *name = "stribeck", *with_added_mass = "stribeck_added_mass";
    static constexpr int inputs = 3;
    T excess, speed;
    constexpr StribeckLaw(const T* in) : CoulombLaw<T>(in), excess(in[1]), speed(in[2]) {}
    constexpr T coefficient(T size) const {
        const T share = size / speed;
        return this->mu + excess * exp(-(share * share));
    }
};

// mu along the axis, ratio of the mu across to it, axis.
template <class T>
struct EllipticLaw : CoulombLaw<T> {
    static constexpr const char *name = "elliptic", *with_added_mass = "elliptic_added_mass";
    static constexpr int inputs = 5;
    T ratio;
    Vec<T> axis;
    constexpr EllipticLaw(const T* in) : CoulombLaw<T>(in), ratio(in[1]), axis{in[2], in[3], in[4]} {}
    constexpr T size(Vec<T> slip) const {
        const auto across = slip - dot(slip, axis) * axis;
        return safe_norm(slip + (1.0 / ratio - 1.0) * across);
    }
};

// Change of velocity in the shape's axes, from slip, distance, normal, dt, offset, recovery speed, the law's
// coefficients and, if any, added mass over own mass.
template <template <class> class Law, bool ADDED_MASS>
struct Response {
    static constexpr const char* name = ADDED_MASS ? Law<TracedScalar>::with_added_mass : Law<TracedScalar>::name;
    static constexpr int inputs = 10 + Law<TracedScalar>::inputs + (ADDED_MASS ? 6 : 0), outputs = 3;
    static constexpr auto constant_inputs = input_bits(7, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto v = r.vec();
        const T distance = r.number();
        const auto normal = r.vec();
        const T dt = r.number(), offset = r.number(), recovery = r.number();
        const Law<T> law(r.at);
        const T needed = (offset - distance) / dt;
        const T min_speed = select(less(recovery, needed), recovery, needed);
        const T approach = dot(v, normal), push = at_least(min_speed - approach, 0.0);
        const auto free = v - approach * normal;
        if constexpr (ADDED_MASS) {
            const auto ratio = Reader<T>{r.at + Law<T>::inputs}.symmetric();
            const auto product = ratio * normal;
            const Symmetric<T> inertia{1.0 + ratio.xx, ratio.xy, ratio.xz, 1.0 + ratio.yy, ratio.yz, 1.0 + ratio.zz};
            const auto correction = solve(inertia, product);
            const T along = dot(correction, normal), impulse = push / (1.0 - along);
            const auto aside = impulse * (along * normal - correction), slip = free + aside;
            const T squared = dot(slip, slip);
            const T inert = 1.0 + dot(slip, ratio * slip) / select(less(0.0, squared), squared, 1.0);
            Writer<T>{out}.vec(push * normal + aside - friction_share(law, slip, impulse / inert) * slip);
        } else {
            Writer<T>{out}.vec(push * normal - friction_share(law, free, push) * free);
        }
    }
    template <class T>
    static constexpr T friction_share(Law<T> law, Vec<T> slip, T push) {
        const T size = law.size(slip), limit = law.coefficient(size) * push;
        const T sticks = less(0.0, limit) * (1.0 - less(limit, size));
        return select(sticks, 1.0, limit / select(less(0.0, size), size, 1.0));
    }
};
template <template <class> class Law>
using WithoutAddedMass = Response<Law, false>;
template <template <class> class Law>
using WithAddedMass = Response<Law, true>;

TC_KERNEL(WithoutAddedMass<CoulombLaw>)
TC_KERNEL(WithoutAddedMass<StribeckLaw>)
TC_KERNEL(WithoutAddedMass<EllipticLaw>)
TC_KERNEL(WithAddedMass<CoulombLaw>)
TC_KERNEL(WithAddedMass<StribeckLaw>)
TC_KERNEL(WithAddedMass<EllipticLaw>)

}  // namespace

}  // namespace tc
