// Signed distance to solids, and its normal, in the solid's own coordinates: torchcloth/boundaries.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

template <class T>
struct Polar {
    T length;
    Vec<T> direction;  // the fallback where there is none
};
template <class T>
constexpr Polar<T> polar(Vec<T> q, Vec<T> fallback) {
    const T length = safe_norm(q);
    const T somewhere = less(0.0, length);
    return {length, select(somewhere, q / select(somewhere, length, 1.0), fallback)};
}

// From the signed distances to a block's pairs of parallel sides: to the block, and the normal's components >= 0.
template <class T>
constexpr Polar<T> beyond(Vec<T> gap) {
    const T second = less(gap.x, gap.y);
    const T larger = select(second, gap.y, gap.x);
    const T third = less(larger, gap.z);
    const T nearest = select(third, gap.z, larger);
    const Vec<T> side{(1.0 - second) * (1.0 - third), second * (1.0 - third), third};
    const auto out = polar(Vec<T>{at_least(gap.x, 0.0), at_least(gap.y, 0.0), at_least(gap.z, 0.0)}, side);
    // Over a face the normal is constant. Near it, q / |q| would get a derivative from rounding, eps / |q|.
    const T edge = less(1.5, less(0.0, gap.x) + less(0.0, gap.y) + less(0.0, gap.z));
    return {select(less(0.0, out.length), out.length, nearest), select(edge, out.direction, side)};
}

template <class T>
constexpr void give(T* out, T distance, Vec<T> normal) {
    Write<T> w{out};
    w.number(distance), w.vec(normal);
}

// p, point, normal. plane.py
struct PlaneDistance {
    static constexpr const char* name = "plane";
    static constexpr int inputs = 9, outputs = 4;
    static constexpr auto fixed = bits(3, 6);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p = r.vec(), point = r.vec(), normal = r.vec();
        give(out, dot(p - point, normal), 1.0 * normal);
    }
};

// p, radius, centre, the way up. solids.py
struct SphereDistance {
    static constexpr const char* name = "sphere";
    static constexpr int inputs = 10, outputs = 4;
    static constexpr auto fixed = bits(4, 6);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p = r.vec();
        const T radius = r.number();
        const auto centre = r.vec();
        const auto from = polar(p - centre, r.vec());
        give(out, from.length - radius, from.direction);
    }
};

// p, edge lengths. solids.py
struct BoxDistance {
    static constexpr const char* name = "box";
    static constexpr int inputs = 6, outputs = 4;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p = r.vec(), half = 0.5 * r.vec();
        const auto [distance, n] = beyond(Vec<T>{abs(p.x) - half.x, abs(p.y) - half.y, abs(p.z) - half.z});
        auto turned = [](T part, T at) { return select(less(at, 0.0), -part, part); };
        give(out, distance, Vec<T>{turned(n.x, p.x), turned(n.y, p.y), turned(n.z, p.z)});
    }
};

// p, radius, start, axis of the segment with its length, a unit vector aside. solids.py
struct CapsuleDistance {
    static constexpr const char* name = "capsule";
    static constexpr int inputs = 13, outputs = 4;
    static constexpr auto fixed = bits(4, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p = r.vec();
        const T radius = r.number();
        const auto q = p - r.vec(), axis = r.vec();
        const T along = at_most(at_least(dot(q, axis) / dot(axis, axis), 0.0), 1.0);
        const auto from = polar(q - along * axis, r.vec());
        give(out, from.length - radius, from.direction);
    }
};

// p, radius, middle, unit axis, half the length, a unit vector aside. solids.py
struct CylinderDistance {
    static constexpr const char* name = "cylinder";
    static constexpr int inputs = 14, outputs = 4;
    static constexpr auto fixed = bits(4, 10);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p = r.vec();
        const T radius = r.number();
        const auto q = p - r.vec(), axis = r.vec();
        const T half = r.number(), height = dot(q, axis);
        const auto barrel = polar(q - height * axis, r.vec());
        // no third pair of sides: as far inside as it takes to never count
        const auto [distance, part] = beyond(Vec<T>{barrel.length - radius, abs(height) - half, constant(half, -1e30)});
        const T top = select(less(height, 0.0), -part.y, part.y);
        give(out, distance, part.x * barrel.direction + top * axis);
    }
};

// p, origin and last node of the grid, cell -> place on the grid in cells, and what is beyond it. mesh_solid.py
struct GridPlace {
    static constexpr const char* name = "grid_place";
    static constexpr int inputs = 10, outputs = 6;
    static constexpr auto fixed = bits(3, 7);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p = r.vec(), origin = r.vec(), last = r.vec();
        const T cell = r.number();
        const auto place = (p - origin) / cell;
        auto kept = [](T at, T most) {
            const T low = at_least(at, 0.0);
            return select(less(most, low), most, low);
        };
        const Vec<T> on{kept(place.x, last.x), kept(place.y, last.y), kept(place.z, last.z)};
        Write<T> w{out};
        w.vec(on), w.vec(place - on);
    }
};

// Fractions of the cell, values at its corners, what is beyond, cell, the way up -> distance, normal. mesh_solid.py
struct GridDistance {
    static constexpr const char* name = "grid_distance";
    static constexpr int inputs = 18, outputs = 4;
    static constexpr auto fixed = bits(3, 8) | bits(14, 4);
    template <class T>
    struct Face {
        T value, y, z;  // and slopes
    };
    template <class T>
    static constexpr Face<T> bilinear(const T* c, T y, T z) {
        const T low = c[0] + z * (c[1] - c[0]), high = c[2] + z * (c[3] - c[2]);
        return {low + y * (high - low), high - low, (c[1] - c[0]) + y * ((c[3] - c[2]) - (c[1] - c[0]))};
    }
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto t = r.vec();
        const auto low = bilinear(in + 3, t.y, t.z), high = bilinear(in + 7, t.y, t.z);
        r.at += 8;
        const auto outside = r.vec();
        const T cell = r.number();
        const Vec<T> slopes{high.value - low.value, low.y + t.x * (high.y - low.y), low.z + t.x * (high.z - low.z)};
        const auto gradient = slopes / cell;
        const T length = safe_norm(gradient), flat = less(length, 1e-3);
        give(out, low.value + t.x * slopes.x + cell * safe_norm(outside),
             select(flat, r.vec(), gradient / select(flat, 1.0, length)));
    }
};

}  // namespace

TC_KERNELS(shape_kernels, PlaneDistance, SphereDistance, BoxDistance, CapsuleDistance, CylinderDistance, GridPlace, GridDistance)

}  // namespace tc
