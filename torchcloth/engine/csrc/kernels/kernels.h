// All kernels of the engine. Each file of this folder gives its own, in a namespace without name: two structs of one name
// in two files would be one. They are compiled side by side.
#pragma once

#include <vector>

#include "../tape.h"

namespace tc {

template <class R> std::vector<Kernel<R>> surface_kernels();
template <class R> std::vector<Kernel<R>> material_kernels();
template <class R> std::vector<Kernel<R>> effect_kernels();
template <class R> std::vector<Kernel<R>> bending_kernels();
template <class R> std::vector<Kernel<R>> friction_kernels();
template <class R> std::vector<Kernel<R>> boundary_kernels();
template <class R> std::vector<Kernel<R>> contact_kernels();
template <class R> std::vector<Kernel<R>> collider_kernels();
template <class R> std::vector<Kernel<R>> shape_kernels();
template <class R> std::vector<Kernel<R>> point_kernels();

template <class R>
std::vector<Kernel<R>> all_kernels() {
    std::vector<Kernel<R>> all;
    for (auto part : {surface_kernels<R>(), material_kernels<R>(), effect_kernels<R>(), bending_kernels<R>(),
                      friction_kernels<R>(), boundary_kernels<R>(), collider_kernels<R>(), shape_kernels<R>(),
                      point_kernels<R>(), contact_kernels<R>()})
        all.insert(all.end(), part.begin(), part.end());
    return all;
}

// A file ends with TC_KERNELS(surface_kernels, Surface, Assemble, ...).
template <class R, class... K>
std::vector<Kernel<R>> listed() { return {kernel<K, R>()...}; }
#define TC_KERNELS(name, ...)                                                          \
    template <> std::vector<Kernel<float>> name<float>() { return listed<float, __VA_ARGS__>(); } \
    template <> std::vector<Kernel<double>> name<double>() { return listed<double, __VA_ARGS__>(); }

}  // namespace tc
