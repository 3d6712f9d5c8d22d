// Status codes of exported functions that allocate memory. No exception may leave the library. Without exceptions (WebAssembly) the
// program stops where memory runs out.
#pragma once
#include <exception>

namespace se {

// Run f. Return 0, or 1 if it throws, which means that memory ran out.
template <class F>
int run_guarded(F&& f) noexcept {
#if defined(__cpp_exceptions)
  try {
    f();
  } catch (const std::exception&) {
    return 1;
  }
#else
  f();
#endif
  return 0;
}

}  // namespace se
