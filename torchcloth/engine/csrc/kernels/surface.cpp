// Kinematics of the triangles, how their stresses reach the vertices, and the step itself.
#include "kernels.h"
#include "../vec.h"

namespace tc {

// Corners, warp and weft coefficients -> f1, f2, cofactors dJ/df1 and dJ/df2, normal, J.
struct Surface {
    static constexpr const char* name = "surface";
    static constexpr int inputs = 13, outputs = 16;
    static constexpr auto fixed = bits(9, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number();
        const auto d1 = x1 - x0, d2 = x2 - x0;
        const auto f1 = a1 * d1 + a2 * d2, f2 = b1 * d1 + b2 * d2;
        const auto normal = cross(f1, f2);
        const T J = sqrt(dot(normal, normal));
        const auto n = normal / J;
        Write<T> w{out};
        w.vec(f1), w.vec(f2), w.vec(cross(f2, n)), w.vec(cross(n, f1)), w.vec(n), w.number(J);
    }
};

// Mean over the corners.
struct Centroid {
    static constexpr const char* name = "centroid";
    static constexpr int inputs = 9, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto a = r.vec(), b = r.vec(), c = r.vec();
        Write<T>{out}.vec((1.0 / 3) * (a + b + c));
    }
};

// Stress columns, warp and weft coefficients, area -> forces on the three corners.
struct Assemble {
    static constexpr const char* name = "assemble";
    static constexpr int inputs = 11, outputs = 9;
    static constexpr auto fixed = bits(6, 5);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p1 = r.vec(), p2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), area = r.number();
        const auto second = (-area) * (a1 * p1 + b1 * p2), third = (-area) * (a2 * p1 + b2 * p2);
        Write<T> w{out};
        w.vec(-(second + third)), w.vec(second), w.vec(third);
    }
};

// A force on a triangle goes to its corners in equal parts.
struct Thirds {
    static constexpr const char* name = "thirds";
    static constexpr int inputs = 3, outputs = 9;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        const auto part = (1.0 / 3) * Read<T>{in}.vec();
        Write<T> w{out};
        w.vec(part), w.vec(part), w.vec(part);
    }
};

// dt, velocity, force, mass -> velocity free of the boundaries.
struct Kick {
    static constexpr const char* name = "kick";
    static constexpr int inputs = 8, outputs = 3;
    static constexpr auto fixed = bits(0, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number();
        const auto v = r.vec(), force = r.vec();
        const T mass = r.number();
        Write<T>{out}.vec(v + dt * (force / mass));
    }
};

// Mass of the air that moves along with a vertex, its own mass, a change of velocity -> the change with that air, so
// written that no air changes nothing, bitwise. dynamics.py
struct Resisted {
    static constexpr const char* name = "resisted";
    static constexpr int inputs = 10, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto mass = r.symmetric();
        const auto air = mass / r.number();
        const auto change = r.vec();
        const Symmetric<T> all{air.xx + 1.0, air.xy, air.xz, air.yy + 1.0, air.yz, air.zz + 1.0};
        Write<T>{out}.vec(change - solve(all, air * change));
    }
};

// Mass of the air, own mass, change of velocity -> what the two were given. dynamics.py
struct Loaded {
    static constexpr const char* name = "loaded";
    static constexpr int inputs = 10, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto air = r.symmetric();
        const T mass = r.number();
        const auto change = r.vec();
        Write<T>{out}.vec(mass * change + air * change);
    }
};

// dt, force, mass -> change of velocity.
struct Push {
    static constexpr const char* name = "push";
    static constexpr int inputs = 5, outputs = 3;
    static constexpr auto fixed = bits(0, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number();
        const auto force = r.vec();
        Write<T>{out}.vec(dt * (force / r.number()));
    }
};

// A vector times a number.
struct Scaled {
    static constexpr const char* name = "scaled3";
    static constexpr int inputs = 4, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T scale = r.number();
        Write<T>{out}.vec(scale * r.vec());
    }
};

// Sum of two vectors.
struct Plus {
    static constexpr const char* name = "plus3";
    static constexpr int inputs = 6, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto a = r.vec();
        Write<T>{out}.vec(a + r.vec());
    }
};

// dt, position, velocity -> position.
struct Drift {
    static constexpr const char* name = "drift";
    static constexpr int inputs = 7, outputs = 3;
    static constexpr auto fixed = bits(0, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number();
        const auto x = r.vec(), v = r.vec();
        Write<T>{out}.vec(x + dt * v);
    }
};

// Numbers go from one place to another, or are added there.
template <int N>
struct Copied {
    static constexpr int inputs = N, outputs = N;
    template <class T>
    static constexpr void run(const T* in, T* out) { for (int i = 0; i < N; i++) out[i] = 1.0 * in[i]; }
};
struct Copy : Copied<3> { static constexpr const char* name = "copy3"; };
struct CopyColumns : Copied<6> { static constexpr const char* name = "copy6"; };

TC_KERNELS(surface_kernels, Surface, Centroid, Assemble, Thirds, Kick, Resisted, Loaded, Push, Scaled, Plus, Drift, Copy, CopyColumns)

}  // namespace tc
