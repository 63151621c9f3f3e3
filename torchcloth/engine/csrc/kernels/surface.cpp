// The step itself, and the parts of a triangle's work, one by one.
#include "kernels.h"
#include "surface.h"

namespace tc {
namespace {

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

// What is left of a change of velocity in the air that moves along, so written that no air changes nothing, bitwise.
// dynamics.py
template <class T>
constexpr Vec<T> resisted(Symmetric<T> air, T mass, Vec<T> change) {
    const auto b = air / mass;
    return change - solve(Symmetric<T>{b.xx + 1.0, b.xy, b.xz, b.yy + 1.0, b.yz, b.zz + 1.0}, b * change);
}

// dt, velocity, force, own mass, mass of the air -> velocity free of the boundaries.
struct KickInAir {
    static constexpr const char* name = "kick_in_air";
    static constexpr int inputs = 14, outputs = 3;
    static constexpr auto fixed = bits(0, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number();
        const auto v = r.vec(), force = r.vec();
        const T mass = r.number();
        Write<T>{out}.vec(v + dt * resisted(r.symmetric(), mass, force / mass));
    }
};

// dt, w_0, w_1, how often held, velocity, before, viscous force, own mass -> the next Chebyshev polynomial of velocities.
// relaxation.py
struct Stage {
    static constexpr const char* name = "stage";
    static constexpr int inputs = 14, outputs = 3;
    static constexpr auto fixed = bits(0, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number(), first = r.number(), slope = r.number(), held = r.number();
        const auto v = r.vec(), before = r.vec(), force = r.vec();
        const T mass = r.number(), share = select(less(held, 0.5), slope * dt, 0.0);
        Write<T>{out}.vec(first * v + share * (force / mass) - before);
    }
};

// The same in the air that moves along.
struct StageInAir {
    static constexpr const char* name = "stage_in_air";
    static constexpr int inputs = 20, outputs = 3;
    static constexpr auto fixed = bits(0, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number(), first = r.number(), slope = r.number(), held = r.number();
        const auto v = r.vec(), before = r.vec(), force = r.vec();
        const T mass = r.number(), share = select(less(held, 0.5), slope * dt, 0.0);
        Write<T>{out}.vec(first * v + share * resisted(r.symmetric(), mass, force / mass) - before);
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
struct CopyStress : Copied<15> { static constexpr const char* name = "copy15"; };

}  // namespace

TC_KERNELS(surface_kernels, Surface, Assemble, Kick, KickInAir, Stage, StageInAir, Loaded, Scaled, Plus, Drift, Copy, CopyStress)

}  // namespace tc
