// How a sheet is bent and what that does: torchcloth/effects/_bent.py, bending.py, saturating.py, crease.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

constexpr double FOLDED = 0.5;  // of effects/_bent.py

// stiffness, viscosity, x, v -> what the plate matrix acts on. effects/bending.py
struct Bent {
    static constexpr const char* name = "bent";
    static constexpr int inputs = 8, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T stiffness = r.number(), viscosity = r.number();
        const auto x = r.vec(), v = r.vec();
        Write<T>{out}.vec(stiffness * x + viscosity * v);
    }
};

// Derivatives of x along ww, ff, sqrt 2 wf, w, f -> normal, stretch, curvature. effects/_bent.py
struct BentSheet {
    static constexpr const char* name = "bent_sheet";
    static constexpr int inputs = 15, outputs = 7;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto ww = r.vec(), ff = r.vec(), wf = r.vec(), warp = r.vec(), weft = r.vec();
        const auto normal = cross(warp, weft);
        const T stretch = at_least(safe_norm(normal), FOLDED);
        const auto n = normal / stretch;
        Write<T> w{out};
        w.vec(n), w.number(stretch), w.vec({dot(ww, n), dot(ff, n), dot(wf, n)});
    }
};

// Derivatives of x, normal, stretch, area, moment -> what the transposed derivatives make forces of. effects/_bent.py
struct BendingStress {
    static constexpr const char* name = "bending_stress";
    static constexpr int inputs = 23, outputs = 15;
    static constexpr auto fixed = bits(19, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto ww = r.vec(), ff = r.vec(), wf = r.vec(), warp = r.vec(), weft = r.vec(), n = r.vec();
        const T stretch = r.number(), area = r.number();
        const auto m = area * r.vec();
        const auto pull = m.x * ww + m.y * ff + m.z * wf;
        const T along = select(less(FOLDED, stretch), dot(pull, n), 0.0);
        const auto turn = (pull - along * n) / stretch;  // on the normal
        Write<T> w{out};
        w.vec(m.x * n), w.vec(m.y * n), w.vec(m.z * n), w.vec(cross(weft, turn)), w.vec(cross(turn, warp));
    }
};

// Stiffnesses warp, weft, cross, twist, rest curvature -> moment on the curvature. effects/bending.py
struct RestMoment {
    static constexpr const char* name = "rest_moment";
    static constexpr int inputs = 7, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const T warp = r.number(), weft = r.number(), across = r.number(), twist = r.number();
        const auto k = r.vec();
        Write<T>{out}.vec({-(warp * k.x + across * k.y), -(across * k.x + weft * k.y), -(twist * k.z)});
    }
};

// Curvature, curl, crease, mobility, dt, yield curvature -> crease, rest curvature. effects/crease.py
struct Crease {
    static constexpr const char* name = "crease";
    static constexpr int inputs = 12, outputs = 6;
    static constexpr auto fixed = bits(10, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto k = r.vec(), curl = r.vec(), crease = r.vec();
        const T mobility = r.number(), dt = r.number(), limit = r.number();
        const auto elastic = k - curl - crease;
        const T size = safe_norm(elastic);
        const T bent = less(limit, size);
        const T excess = select(bent, 1.0 - limit / select(bent, size, 1.0), 0.0);
        const auto after = crease - (expm1(-(mobility * dt)) * excess) * elastic;
        Write<T> w{out};
        w.vec(after), w.vec(curl + after);
    }
};

// Second derivatives of x, area, moment, curvature -> what the transposed derivatives pull with. effects/saturating.py
struct Saturating {
    static constexpr const char* name = "saturating";
    static constexpr int inputs = 12, outputs = 15;
    static constexpr auto fixed = bits(9, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto ww = r.vec(), ff = r.vec(), wf = r.vec();
        const T area = r.number(), moment = r.number(), curvature = r.number();
        const T squared = dot(ww, ww) + dot(ff, ff) + dot(wf, wf) + curvature * curvature;
        const T scale = area * (moment / sqrt(squared));
        Write<T> w{out};
        w.vec(scale * ww), w.vec(scale * ff), w.vec(scale * wf);
        for (int slope = 0; slope < 6; slope++) w.number(constant(scale, 0.0));
    }
};

}  // namespace

TC_KERNELS(bending_kernels, Bent, BentSheet, BendingStress, RestMoment, Crease, Saturating)

}  // namespace tc
