// Registration of kernels. A file of this folder defines its kernels in a namespace without name, because two structs
// of one name in two files would be one, and registers each by TC_KERNEL. The files are compiled in parallel.
#pragma once

#include <algorithm>
#include <cstring>
#include <vector>

#include "../tape.h"

namespace tc {

template <class R>
std::vector<Kernel<R>>& registered_kernels() {
    static std::vector<Kernel<R>> kernels;
    return kernels;
}

// A static object of this type registers a kernel when the library is loaded.
template <class K>
struct RegisterKernel {
    RegisterKernel() {
        registered_kernels<float>().push_back(kernel<K, float>());
        registered_kernels<double>().push_back(kernel<K, double>());
    }
};
#define TC_JOIN_(a, b) a##b
#define TC_JOIN(a, b) TC_JOIN_(a, b)
#define TC_KERNEL(...) [[maybe_unused]] const RegisterKernel<__VA_ARGS__> TC_JOIN(registered_, __COUNTER__){};

// All kernels, sorted by name: their numbers do not depend on the order in which files are linked.
template <class R>
const std::vector<Kernel<R>>& all_kernels() {
    static const std::vector<Kernel<R>> sorted = [] {
        auto kernels = registered_kernels<R>();
        std::sort(kernels.begin(), kernels.end(), [](const Kernel<R>& a, const Kernel<R>& b) {
            return std::strcmp(a.name, b.name) < 0;
        });
        return kernels;
    }();
    return sorted;
}

}  // namespace tc
