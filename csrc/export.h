// What every exported function is marked with: plain C names, visible from the shared library. No exception may leave one.
#pragma once
#include <exception>

#if defined(_WIN32)
#define SE_EXPORT extern "C" __declspec(dllexport)
#else
#define SE_EXPORT extern "C" __attribute__((visibility("default")))
#endif

namespace se {

// For functions that take memory: 0, or 1 where there was not enough.
template <class F>
int guarded(F&& f) noexcept {
  try {
    f();
    return 0;
  } catch (const std::exception&) {
    return 1;
  }
}

}  // namespace se
