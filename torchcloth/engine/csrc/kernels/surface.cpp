// The step itself, and the parts of a triangle's work, one by one.
#include "kernels.h"
#include "surface.h"

namespace tc {

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

// A vector goes from one field to another.
struct Copy {
    static constexpr const char* name = "copy3";
    static constexpr int inputs = 3, outputs = 3;
    template <class T>
    static constexpr void run(const T* in, T* out) { Write<T>{out}.vec(1.0 * Read<T>{in}.vec()); }
};

TC_KERNELS(surface_kernels, Surface, Assemble, Thirds, Kick, Drift, Copy)

}  // namespace tc
