// The step itself, and the parts of a triangle's work, one by one.
#include "kernels.h"
#include "surface.h"

namespace tc {
namespace {

// What is left of a change of velocity in the air that moves along, so written that no air changes nothing, bitwise.
// dynamics.py
template <class T>
constexpr Vec<T> resisted(Symmetric<T> air, T mass, Vec<T> change) {
    const auto b = air / mass;
    return change - solve(Symmetric<T>{b.xx + 1.0, b.xy, b.xz, b.yy + 1.0, b.yz, b.zz + 1.0}, b * change);
}

// Force, own mass, mass of the air if there is any -> change of velocity in unit time.
template <bool AIR, class T>
constexpr Vec<T> accelerated(Read<T>& r) {
    const auto force = r.vec();
    const T mass = r.number();
    if constexpr (AIR) return resisted(r.symmetric(), mass, force / mass);
    else return force / mass;
}

// dt, velocity, force, mass(es) -> velocity free of the boundaries.
template <bool AIR>
struct Kicked {
    static constexpr int inputs = AIR ? 14 : 8, outputs = 3;
    static constexpr auto fixed = bits(0, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number();
        const auto v = r.vec();
        Write<T>{out}.vec(v + dt * accelerated<AIR>(r));
    }
};
struct Kick : Kicked<false> { static constexpr const char* name = "kick"; };
struct KickInAir : Kicked<true> { static constexpr const char* name = "kick_in_air"; };

// dt, w_0, w_1, how often held, velocity, before, viscous force, mass(es) -> the next Chebyshev polynomial of velocities.
// relaxation.py
template <bool AIR>
struct Staged {
    static constexpr int inputs = AIR ? 20 : 14, outputs = 3;
    static constexpr auto fixed = bits(0, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number(), first = r.number(), slope = r.number(), held = r.number();
        const auto v = r.vec(), before = r.vec();
        const T share = select(less(held, 0.5), slope * dt, 0.0);
        Write<T>{out}.vec(first * v + share * accelerated<AIR>(r) - before);
    }
};
struct Stage : Staged<false> { static constexpr const char* name = "stage"; };
struct StageInAir : Staged<true> { static constexpr const char* name = "stage_in_air"; };

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

// The same with what was lost of earlier steps, as it was too small to be added to the position -> position, what is lost
// now (Kahan 1965). Derivatives are those of what is added up.
struct DriftOn {
    static constexpr const char* name = "drift_on";
    static constexpr int inputs = 10, outputs = 6;
    static constexpr auto fixed = bits(0, 1) | bits(7, 3);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T dt = r.number();
        const auto x = r.vec(), v = r.vec();
        const auto way = dt * v + r.vec();
        const auto after = x + way;
        Write<T> w{out};
        w.vec(after), w.vec(way - (after - x));
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

TC_KERNELS(surface_kernels, Surface, Edges, Assemble, Kick, KickInAir, Stage, StageInAir, Loaded, Scaled, Plus, Drift, DriftOn, Copy, CopyStress)

}  // namespace tc
