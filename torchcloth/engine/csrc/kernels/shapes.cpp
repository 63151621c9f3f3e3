// Signed distances to solids, and their normals, in the solid's coordinates: torchcloth/boundaries.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

template <class T>
struct Polar {
    T length;
    Vec<T> direction;  // the fallback where the length is 0
};
template <class T>
constexpr Polar<T> polar(Vec<T> q, Vec<T> fallback) {
    const T length = safe_norm(q);
    const T is_positive = less(0.0, length);
    return {length, select(is_positive, q / select(is_positive, length, 1.0), fallback)};
}

// Distance to a block and the absolute components of its normal, from the signed distances to its pairs of parallel
// sides.
template <class T>
constexpr Polar<T> block_distance(Vec<T> gap) {
    const T second = less(gap.x, gap.y);
    const T larger = select(second, gap.y, gap.x);
    const T third = less(larger, gap.z);
    const T nearest = select(third, gap.z, larger);
    const Vec<T> side{(1.0 - second) * (1.0 - third), second * (1.0 - third), third};
    const auto out = polar(Vec<T>{at_least(gap.x, 0.0), at_least(gap.y, 0.0), at_least(gap.z, 0.0)}, side);
    // Over a face the normal is constant. Near the face, q / |q| would have a derivative of rounding, eps / |q|.
    const T edge = less(1.5, less(0.0, gap.x) + less(0.0, gap.y) + less(0.0, gap.z));
    return {select(less(0.0, out.length), out.length, nearest), select(edge, out.direction, side)};
}

template <class T>
constexpr void write(T* out, T distance, Vec<T> normal) {
    Writer<T> w{out};
    w.number(distance), w.vec(normal);
}

// From p, point and normal. plane.py
struct PlaneDistance {
    static constexpr const char* name = "plane_distance";
    static constexpr int inputs = 9, outputs = 4;
    static constexpr auto constant_inputs = input_bits(3, 6);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p = r.vec(), point = r.vec(), normal = r.vec();
        write(out, dot(p - point, normal), 1.0 * normal);
    }
};
TC_KERNEL(PlaneDistance)

// From p, radius, centre and the direction up. solids.py
struct SphereDistance {
    static constexpr const char* name = "sphere_distance";
    static constexpr int inputs = 10, outputs = 4;
    static constexpr auto constant_inputs = input_bits(4, 6);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p = r.vec();
        const T radius = r.number();
        const auto centre = r.vec();
        const auto from = polar(p - centre, r.vec());
        write(out, from.length - radius, from.direction);
    }
};
TC_KERNEL(SphereDistance)

// From p and the edge lengths. solids.py
struct BoxDistance {
    static constexpr const char* name = "box_distance";
    static constexpr int inputs = 6, outputs = 4;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p = r.vec(), half = 0.5 * r.vec();
        const auto [distance, n] = block_distance(Vec<T>{abs(p.x) - half.x, abs(p.y) - half.y, abs(p.z) - half.z});
        auto with_sign = [](T part, T at) { return select(less(at, 0.0), -part, part); };
        write(out, distance, Vec<T>{with_sign(n.x, p.x), with_sign(n.y, p.y), with_sign(n.z, p.z)});
    }
};
TC_KERNEL(BoxDistance)

// From p, radius, start and axis of the segment (with its length), and a unit vector across. solids.py
struct CapsuleDistance {
    static constexpr const char* name = "capsule_distance";
    static constexpr int inputs = 13, outputs = 4;
    static constexpr auto constant_inputs = input_bits(4, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p = r.vec();
        const T radius = r.number();
        const auto q = p - r.vec(), axis = r.vec();
        const T along = at_most(at_least(dot(q, axis) / dot(axis, axis), 0.0), 1.0);
        const auto from = polar(q - along * axis, r.vec());
        write(out, from.length - radius, from.direction);
    }
};
TC_KERNEL(CapsuleDistance)

// From p, radius, centre, unit axis, half the length and a unit vector across. solids.py
struct CylinderDistance {
    static constexpr const char* name = "cylinder_distance";
    static constexpr int inputs = 14, outputs = 4;
    static constexpr auto constant_inputs = input_bits(4, 10);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p = r.vec();
        const T radius = r.number();
        const auto q = p - r.vec(), axis = r.vec();
        const T half = r.number(), height = dot(q, axis);
        const auto barrel = polar(q - height * axis, r.vec());
        // there is no third pair of sides: so far inside that it never counts
        const auto [distance, part] =
            block_distance(Vec<T>{barrel.length - radius, abs(height) - half, constant(half, -1e30)});
        const T top = select(less(height, 0.0), -part.y, part.y);
        write(out, distance, part.x * barrel.direction + top * axis);
    }
};
TC_KERNEL(CylinderDistance)

// Place in the grid in cells and the distance beyond it, from p, origin and last node of the grid and cell.
// mesh_solid.py
struct GridCoordinates {
    static constexpr const char* name = "grid_coordinates";
    static constexpr int inputs = 10, outputs = 6;
    static constexpr auto constant_inputs = input_bits(3, 7);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p = r.vec(), origin = r.vec(), last = r.vec();
        const T cell = r.number();
        const auto place = (p - origin) / cell;
        auto clamp = [](T at, T last) {
            const T positive = at_least(at, 0.0);
            return select(less(last, positive), last, positive);
        };
        const Vec<T> on{clamp(place.x, last.x), clamp(place.y, last.y), clamp(place.z, last.z)};
        Writer<T> w{out};
        w.vec(on), w.vec(place - on);
    }
};
TC_KERNEL(GridCoordinates)

// Distance and normal, from the fractions of the cell, the values at its corners, the distance beyond the grid, the
// cell's size and the direction up. mesh_solid.py
struct GridDistance {
    static constexpr const char* name = "grid_distance";
    static constexpr int inputs = 18, outputs = 4;
    static constexpr auto constant_inputs = input_bits(3, 8) | input_bits(14, 4);
    template <class T>
    struct Face {
        T value, y, z;  // and the slopes along y and z
    };
    template <class T>
    static constexpr Face<T> bilinear(const T* c, T y, T z) {
        const T low = c[0] + z * (c[1] - c[0]), high = c[2] + z * (c[3] - c[2]);
        return {low + y * (high - low), high - low, (c[1] - c[0]) + y * ((c[3] - c[2]) - (c[1] - c[0]))};
    }
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto t = r.vec();
        const auto low = bilinear(in + 3, t.y, t.z), high = bilinear(in + 7, t.y, t.z);
        r.at += 8;
        const auto outside = r.vec();
        const T cell = r.number();
        const Vec<T> slopes{high.value - low.value, low.y + t.x * (high.y - low.y), low.z + t.x * (high.z - low.z)};
        const auto gradient = slopes / cell;
        const T length = safe_norm(gradient), flat = less(length, 1e-3);
        write(out, low.value + t.x * slopes.x + cell * safe_norm(outside),
             select(flat, r.vec(), gradient / select(flat, 1.0, length)));
    }
};
TC_KERNEL(GridDistance)

}  // namespace

}  // namespace tc
