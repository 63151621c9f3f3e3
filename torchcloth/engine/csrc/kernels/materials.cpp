// Membrane laws: torchcloth/materials.
#include "kernels.h"
#include "surface.h"

namespace tc {

// materials/corotated.py with the cofactors (g_ff f1 - g_wf f2) / J: 2 mu (F - polar rotation) + pressure cof F.
template <class T>
constexpr Stress<T> corotated(Metric<T> g, T mu, T pressure) {
    const T bend = 2.0 * mu / sqrt(g.warp + g.weft + 2.0 * g.J);
    const T along = 2.0 * mu - bend, across = (pressure - bend) / g.J;
    return {along + across * g.weft, along + across * g.warp, -(across * g.shear)};
}

// mu, lambda. materials/aep.py
struct Isotropic : Sheet<Isotropic> {
    static constexpr const char* name = "aep";
    static constexpr int numbers = 2;
    template <class T>
    static constexpr Stress<T> stress(Metric<T> g, const T* c) { return corotated(g, c[0], c[1] * (g.J - 1.0)); }
};

TC_KERNELS(material_kernels, Isotropic)

}  // namespace tc
