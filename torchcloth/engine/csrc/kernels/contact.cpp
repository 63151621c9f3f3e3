// Contact between layers: torchcloth/dynamics/contact/self_contact.py, transfer.py and
// torchcloth/materials/director.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// Value at a point, from barycentric coordinates and the values at the corners.
template <class T>
constexpr Vec<T> at_point(Vec<T> place, Vec<T> a, Vec<T> b, Vec<T> c) {
    return place.x * a + place.y * b + place.z * c;
}

// Mass of a point, from areal density, area and the point's fraction of it.
struct PointMass {
    static constexpr const char* name = "point_mass";
    static constexpr int inputs = 3, outputs = 1;
    static constexpr auto constant_inputs = input_bits(1, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) { out[0] = in[0] * in[1] * in[2]; }
};
TC_KERNEL(PointMass)

// A point's stress columns and pull on its director, from n, J, f1, f2, d3, closing rate, areal density, contact and
// shear stiffness, area, fraction, dt, clearance, damping and its limit by the substep.
// self_contact.compute_director_forces
struct ContactPressure {
    static constexpr const char* name = "contact_pressure";
    static constexpr int inputs = 23, outputs = 9;
    static constexpr auto constant_inputs = input_bits(17, 6);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto n = r.vec();
        const T J = r.number();
        const auto f1 = r.vec(), f2 = r.vec(), d3 = r.vec();
        const T closing = r.number(), density = r.number(), contact = r.number(), shear = r.number();
        const T area = r.number(), share = r.number(), dt = r.number(), clearance = r.number(), damping = r.number();
        const T slowing = r.number();
        const auto d = d3 + clearance * n;
        const T height = dot(n, d);
        const T gap = at_least(1.0 - height, 0.0);
        const T slope = shear * height + contact * gap * gap;
        auto by_director = shear * d - slope * n;
        auto by_normal = clearance * by_director - slope * d;
        const T press = at_most(dot(by_director, n), 0.0);
        const T slowed = 1.0 - (dt * slowing) * press / density;
        const T loss = press * at_least(damping * closing / slowed, -1.0);
        by_normal = by_normal + loss * d3;
        by_director = by_director + loss * n;
        const auto turn = (share / J) * (by_normal - dot(by_normal, n) * n);
        Writer<T> w{out};
        w.vec(cross(f2, turn)), w.vec(cross(turn, f1)), w.vec((area * share) * by_director);
    }
};
TC_KERNEL(ContactPressure)

// Offset of a point from its lowest node in spacings, from spacing and its inverse, shift of the grid, lowest node,
// place and corners.
struct GridOffset {
    static constexpr const char* name = "grid_offset";
    static constexpr int inputs = 20, outputs = 3;
    static constexpr auto constant_inputs = input_bits(0, 11);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        r.number();
        const T inverse = r.number();
        const auto shift = r.vec(), lowest = r.vec(), place = r.vec(), a = r.vec(), b = r.vec(), c = r.vec();
        Writer<T>{out}.vec(inverse * at_point(place, a, b, c) + (shift - lowest));
    }
};
TC_KERNEL(GridOffset)

// Shares of the weights (mass) and of their slopes (force along d3 . slope), from spacing and its inverse, d3, mass,
// pull.
struct ForceShares {
    static constexpr const char* name = "force_shares";
    static constexpr int inputs = 9, outputs = 16;
    static constexpr auto constant_inputs = input_bits(0, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        r.number();
        const T inverse = r.number();
        const auto d3 = inverse * r.vec();
        const T mass = r.number(), zero = constant(mass, 0.0);
        const auto force = -r.vec();
        Writer<T> w{out};
        w.number(mass), w.vec({zero, zero, zero});
        for (T d : {d3.x, d3.y, d3.z}) w.number(zero), w.vec(d * force);
    }
};
TC_KERNEL(ForceShares)

// Forces on the corners, from surface, mass, the sums of the nodes' accelerations, place, shape, spacing and its
// inverse. self_contact.contact_velocity_change
struct CornerForces {
    static constexpr const char* name = "corner_forces";
    static constexpr int inputs = 42, outputs = 9;
    static constexpr auto constant_inputs = input_bits(33, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
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
        Writer<T> w{out};
        w.vec(place.x * momentum - (b + c)), w.vec(place.y * momentum + b), w.vec(place.z * momentum + c);
    }
};
TC_KERNEL(CornerForces)

// Shares of the momentum in the weights and in the arms, from surface, velocities of the corners, mass, place, shape,
// spacing and its inverse. transfer.affine_momentum of self_contact._mesh_velocity_gradient
struct MomentumShares {
    static constexpr const char* name = "momentum_shares";
    static constexpr int inputs = 35, outputs = 16;
    static constexpr auto constant_inputs = input_bits(26, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
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
        const T zero = constant(mass, 0.0);
        Writer<T> w{out};
        w.number(zero), w.vec(mass * at_point(place, v0, v1, v2));
        w.number(zero), w.vec(column(dual1.x, dual2.x, n.x));
        w.number(zero), w.vec(column(dual1.y, dual2.y, n.y));
        w.number(zero), w.vec(column(dual1.z, dual2.z, n.z));
    }
};
TC_KERNEL(MomentumShares)

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

// Director and closing rate after the substep, from the normals before and after, d3, the sums of the nodes'
// velocities, spacing and its inverse, contact, shear, cone, dt and clearance. self_contact.advance_directors
struct UpdateDirector {
    static constexpr const char* name = "update_director";
    static constexpr int inputs = 32, outputs = 4;
    static constexpr auto constant_inputs = input_bits(25, 2) | input_bits(30, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto old = r.vec(), n = r.vec(), d3 = r.vec();
        r.number(), r.vec(), r.number();
        const auto along_x = r.vec();
        r.number();
        const auto along_y = r.vec();
        r.number();
        const auto along_z = r.vec();
        r.number();
        const auto rate = r.number() * (d3.x * along_x + d3.y * along_y + d3.z * along_z);
        const T contact = r.number(), shear = r.number(), cone = r.number(), dt = r.number(), clearance = r.number();
        const auto moved = d3 + dt * rate;
        const T height = dot(moved, n);
        const auto pressed = return_map(contact, shear, cone, n, moved + clearance * n) - clearance * n;
        Writer<T> w{out};
        w.vec(select(less(1.0 - clearance, height), at_most(height, 1.0) * n, pressed));
        w.number((dot(d3, old) - height) / dt);
    }
};
TC_KERNEL(UpdateDirector)

// Director and closing rate far from other layers, from the normal.
struct ResetDirector {
    static constexpr const char* name = "reset_director";
    static constexpr int inputs = 3, outputs = 4;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Writer<T> w{out};
        w.vec(1.0 * Reader<T>{in}.vec()), w.number(constant(in[0], 0.0));
    }
};
TC_KERNEL(ResetDirector)

}  // namespace

}  // namespace tc
