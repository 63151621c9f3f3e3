// Contact between layers: torchcloth/dynamics/contact/self_contact.py, dynamics/contact/transfer.py and materials/director.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Barycentric coordinates, values at the corners -> value at the point.
template <class T>
constexpr Vec<T> at_point(Vec<T> place, Vec<T> a, Vec<T> b, Vec<T> c) { return place.x * a + place.y * b + place.z * c; }

// Areal density, area, share of a point -> its mass.
struct PointMass {
    static constexpr const char* name = "point_mass";
    static constexpr int inputs = 3, outputs = 1;
    static constexpr auto fixed = bits(1, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) { out[0] = in[0] * in[1] * in[2]; }
};

// n, J, f1, f2, d3, closing, areal density, contact, shear, area, share, dt, play, damping, slowing -> what the point
// adds to the stress columns, pull, mass. self_contact.pressure
struct Pressure {
    static constexpr const char* name = "pressure";
    static constexpr int inputs = 23, outputs = 9;
    static constexpr auto fixed = bits(17, 6);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto n = r.vec();
        const T J = r.number();
        const auto f1 = r.vec(), f2 = r.vec(), d3 = r.vec();
        const T closing = r.number(), density = r.number(), contact = r.number(), shear = r.number();
        const T area = r.number(), share = r.number(), dt = r.number(), play = r.number(), damping = r.number();
        const T slowing = r.number();
        const auto d = d3 + play * n;
        const T height = dot(n, d);
        const T gap = at_least(1.0 - height, 0.0);
        const T slope = shear * height + contact * gap * gap;
        auto by_director = shear * d - slope * n;
        auto by_normal = play * by_director - slope * d;
        const T press = at_most(dot(by_director, n), 0.0);
        const T slowed = 1.0 - (dt * slowing) * press / density;
        const T loss = press * at_least(damping * closing / slowed, -1.0);
        by_normal = by_normal + loss * d3;
        by_director = by_director + loss * n;
        const auto turn = (share / J) * (by_normal - dot(by_normal, n) * n);
        Write<T> w{out};
        w.vec(cross(f2, turn)), w.vec(cross(turn, f1)), w.vec((area * share) * by_director);
    }
};

// Spacing and one over it, lowest node, place, corners -> where the point is among its nodes, in spacings.
struct Offset {
    static constexpr const char* name = "offset";
    static constexpr int inputs = 17, outputs = 3;
    static constexpr auto fixed = bits(0, 8);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        r.number();
        const T inverse = r.number();
        const auto lowest = r.vec(), place = r.vec(), a = r.vec(), b = r.vec(), c = r.vec();
        Write<T>{out}.vec(inverse * at_point(place, a, b, c) - lowest);
    }
};

// Spacing and one over it, d3, mass, pull -> shares of the weights (mass) and of their slopes (force along d3 . slope).
struct ForceShares {
    static constexpr const char* name = "force_shares";
    static constexpr int inputs = 9, outputs = 16;
    static constexpr auto fixed = bits(0, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        r.number();
        const T inverse = r.number();
        const auto d3 = inverse * r.vec();
        const T mass = r.number(), nothing = constant(mass, 0.0);
        const auto force = -r.vec();
        Write<T> w{out};
        w.number(mass), w.vec({nothing, nothing, nothing});
        for (T d : {d3.x, d3.y, d3.z}) w.number(nothing), w.vec(d * force);
    }
};

// Surface, mass, what was collected of the nodes' accelerations, place, shape, spacing and one over it -> forces on the
// corners.
// self_contact.repulsion
struct CornerForces {
    static constexpr const char* name = "corner_forces";
    static constexpr int inputs = 42, outputs = 9;
    static constexpr auto fixed = bits(33, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        r.vec(), r.vec();
        const auto c1 = r.vec(), c2 = r.vec(), n = r.vec();
        const T J = r.number(), mass = r.number();
        r.number();
        const auto momentum = mass * r.vec();
        r.number();
        const auto first_arm = r.vec();
        r.number();
        const auto second_arm = r.vec();
        r.number();
        const auto third_arm = r.vec();
        const auto place = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number();
        const T scale = mass * r.number();
        const auto x = scale * first_arm, y = scale * second_arm, z = scale * third_arm;  // columns of the moment
        const auto times = [&](Vec<T> u) { return u.x * x + u.y * y + u.z * z; };
        const auto dual1 = c1 / J, dual2 = c2 / J, normal = times(n);
        const auto first = times(dual1) - dot(normal, dual1) * n, second = times(dual2) - dot(normal, dual2) * n;
        const auto b = a1 * first + b1 * second, c = a2 * first + b2 * second;
        Write<T> w{out};
        w.vec(place.x * momentum - (b + c)), w.vec(place.y * momentum + b), w.vec(place.z * momentum + c);
    }
};

// Surface, corners' velocities, mass, place, shape, spacing and one over it -> shares of the weights and of the arms in
// the momentum.
// transfer.carried_momentum of self_contact._mesh_gradient
struct Carried {
    static constexpr const char* name = "carried";
    static constexpr int inputs = 35, outputs = 16;
    static constexpr auto fixed = bits(26, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        r.vec(), r.vec();
        const auto c1 = r.vec(), c2 = r.vec(), n = r.vec();
        const T J = r.number();
        const auto v0 = r.vec(), v1 = r.vec(), v2 = r.vec();
        const T mass = r.number();
        const auto place = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number();
        const T scale = mass * r.number();
        const auto d1 = v1 - v0, d2 = v2 - v0;
        const auto rate1 = a1 * d1 + a2 * d2, rate2 = b1 * d1 + b2 * d2;
        const auto dual1 = c1 / J, dual2 = c2 / J;
        const auto spin = -(dot(rate1, n) * dual1 + dot(rate2, n) * dual2);
        const auto column = [&](T x, T y, T z) { return scale * (x * rate1 + y * rate2 + z * spin); };
        const T nothing = constant(mass, 0.0);
        Write<T> w{out};
        w.number(nothing), w.vec(mass * at_point(place, v0, v1, v2));
        w.number(nothing), w.vec(column(dual1.x, dual2.x, n.x));
        w.number(nothing), w.vec(column(dual1.y, dual2.y, n.y));
        w.number(nothing), w.vec(column(dual1.z, dual2.z, n.z));
    }
};

// Director after plastic flow. DirectorMaterial.return_map
template <class T>
constexpr Vec<T> return_map(T contact, T shear, T cone, Vec<T> n, Vec<T> d) {
    const T height = dot(n, d);
    const auto r = d - height * n;
    const T gap = at_least(1.0 - height, 0.0);
    const T limit = cone * contact * gap * gap, friction = shear * safe_norm(r);
    const T slips = less(limit, friction);
    const T keep = select(slips, limit / select(slips, friction, 1.0), 1.0);
    return select(less(1.0, height), n, keep * r + height * n);
}

// Normal before and after, d3, what was collected of the nodes' velocities, spacing and one over it, contact, shear, cone,
// dt, play -> d3, closing. self_contact.follow
struct Follow {
    static constexpr const char* name = "follow";
    static constexpr int inputs = 32, outputs = 4;
    static constexpr auto fixed = bits(25, 2) | bits(30, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto old = r.vec(), n = r.vec(), d3 = r.vec();
        r.number(), r.vec(), r.number();
        const auto along_x = r.vec();
        r.number();
        const auto along_y = r.vec();
        r.number();
        const auto along_z = r.vec();
        r.number();
        const auto rate = r.number() * (d3.x * along_x + d3.y * along_y + d3.z * along_z);
        const T contact = r.number(), shear = r.number(), cone = r.number(), dt = r.number(), play = r.number();
        const auto moved = d3 + dt * rate;
        const T height = dot(moved, n);
        const auto pressed = return_map(contact, shear, cone, n, moved + play * n) - play * n;
        Write<T> w{out};
        w.vec(select(less(1.0 - play, height), at_most(height, 1.0) * n, pressed));
        w.number((dot(d3, old) - height) / dt);
    }
};

// Normal -> director and closing of what is far from other layers.
struct Alone {
    static constexpr const char* name = "alone";
    static constexpr int inputs = 3, outputs = 4;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Write<T> w{out};
        w.vec(1.0 * Read<T>{in}.vec()), w.number(constant(in[0], 0.0));
    }
};

}  // namespace

TC_KERNELS(contact_kernels, PointMass, Pressure, Offset, ForceShares, CornerForces, Carried, Follow, Alone)

}  // namespace tc
