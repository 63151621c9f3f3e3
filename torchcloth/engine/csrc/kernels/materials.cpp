// Membrane laws: torchcloth/materials.
#include "kernels.h"
#include "../vec.h"

namespace tc {

// materials/corotated.py: 2 mu (F - polar rotation) + pressure cof F.
template <class T>
constexpr void corotated(T mu, T pressure, Vec<T> f1, Vec<T> f2, Vec<T> c1, Vec<T> c2, T J, Vec<T>& p1, Vec<T>& p2) {
    const T s = sqrt(dot(f1, f1) + dot(f2, f2) + 2.0 * J);
    const T bend = 2.0 * mu / s;
    const T along = 2.0 * mu - bend, across = pressure - bend;
    p1 = along * f1 + across * c1;
    p2 = along * f2 + across * c2;
}

// f1, f2, cofactors, n, J, mu, lambda -> stress columns. materials/aep.py
struct Isotropic {
    static constexpr const char* name = "aep";
    static constexpr int inputs = 18, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec(), c1 = r.vec(), c2 = r.vec();
        r.vec();
        const T J = r.number(), mu = r.number(), lam = r.number();
        Vec<T> p1 = f1, p2 = f2;
        corotated(mu, lam * (J - 1.0), f1, f2, c1, c2, J, p1, p2);
        Write<T> w{out};
        w.vec(p1), w.vec(p2);
    }
};

TC_KERNELS(material_kernels, Isotropic)

}  // namespace tc
