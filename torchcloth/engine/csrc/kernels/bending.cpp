// Curvature of a sheet, and forces of bending: torchcloth/effects/_bending_stencil.py, bending.py, saturating.py,
// crease.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {
namespace {

// MIN_FIT_AREA_RATIO of effects/_bending_stencil.py: a fit with less has no normal
constexpr double MIN_AREA_RATIO = 0.5;

// The vector that the plate matrix multiplies: stiffness x + viscosity v. effects/bending.py
struct PlateOperand {
    static constexpr const char* name = "plate_operand";
    static constexpr int inputs = 8, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T stiffness = r.number(), viscosity = r.number();
        const auto x = r.vec(), v = r.vec();
        Writer<T>{out}.vec(stiffness * x + viscosity * v);
    }
};
TC_KERNEL(PlateOperand)

// Normal, area ratio and curvature, from the derivatives of x along ww, ff, sqrt 2 wf, w, f.
// effects/_bending_stencil.py
struct SheetCurvature {
    static constexpr const char* name = "sheet_curvature";
    static constexpr int inputs = 15, outputs = 7;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto ww = r.vec(), ff = r.vec(), wf = r.vec(), warp = r.vec(), weft = r.vec();
        const auto normal = cross(warp, weft);
        const T ratio = at_least(safe_norm(normal), MIN_AREA_RATIO);
        const auto n = normal / ratio;
        Writer<T> w{out};
        w.vec(n), w.number(ratio), w.vec({dot(ww, n), dot(ff, n), dot(wf, n)});
    }
};
TC_KERNEL(SheetCurvature)

// What the transposed derivatives turn into forces, from the derivatives of x, normal, area ratio, area and moment.
// effects/_bending_stencil.py
struct BendingStress {
    static constexpr const char* name = "bending_stress";
    static constexpr int inputs = 23, outputs = 15;
    static constexpr auto constant_inputs = input_bits(19, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto ww = r.vec(), ff = r.vec(), wf = r.vec(), warp = r.vec(), weft = r.vec(), n = r.vec();
        const T ratio = r.number(), area = r.number();
        const auto m = area * r.vec();
        const auto pull = m.x * ww + m.y * ff + m.z * wf;
        const T along = select(less(MIN_AREA_RATIO, ratio), dot(pull, n), 0.0);
        const auto turn = (pull - along * n) / ratio;  // acts on the normal
        Writer<T> w{out};
        w.vec(m.x * n), w.vec(m.y * n), w.vec(m.z * n), w.vec(cross(weft, turn)), w.vec(cross(turn, warp));
    }
};
TC_KERNEL(BendingStress)

// Moment of the rest curvature, from the stiffnesses warp, weft, cross and twist. effects/bending.py
struct RestMoment {
    static constexpr const char* name = "rest_moment";
    static constexpr int inputs = 7, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const T warp = r.number(), weft = r.number(), across = r.number(), twist = r.number();
        const auto k = r.vec();
        Writer<T>{out}.vec({-(warp * k.x + across * k.y), -(across * k.x + weft * k.y), -(twist * k.z)});
    }
};
TC_KERNEL(RestMoment)

// Crease and rest curvature after the substep, from curvature, curl, crease, mobility, dt and yield curvature.
// effects/crease.py
struct Crease {
    static constexpr const char* name = "crease";
    static constexpr int inputs = 12, outputs = 6;
    static constexpr auto constant_inputs = input_bits(10, 2);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto k = r.vec(), curl = r.vec(), crease = r.vec();
        const T mobility = r.number(), dt = r.number(), limit = r.number();
        const auto elastic = k - curl - crease;
        const T size = safe_norm(elastic);
        const T yields = less(limit, size);
        const T excess = select(yields, 1.0 - limit / select(yields, size, 1.0), 0.0);
        const auto after = crease - (expm1(-(mobility * dt)) * excess) * elastic;
        Writer<T> w{out};
        w.vec(after), w.vec(curl + after);
    }
};
TC_KERNEL(Crease)

// What the transposed derivatives turn into forces, from the second derivatives of x, area, moment and curvature.
// effects/saturating.py
struct SaturatingBending {
    static constexpr const char* name = "saturating_bending";
    static constexpr int inputs = 12, outputs = 15;
    static constexpr auto constant_inputs = input_bits(9, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto ww = r.vec(), ff = r.vec(), wf = r.vec();
        const T area = r.number(), moment = r.number(), curvature = r.number();
        const T squared = dot(ww, ww) + dot(ff, ff) + dot(wf, wf) + curvature * curvature;
        const T scale = area * (moment / sqrt(squared));
        Writer<T> w{out};
        w.vec(scale * ww), w.vec(scale * ff), w.vec(scale * wf);
        for (int slope = 0; slope < 6; slope++) w.number(constant(scale, 0.0));
    }
};
TC_KERNEL(SaturatingBending)

}  // namespace

}  // namespace tc
