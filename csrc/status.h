// Status codes of exported functions that allocate memory. No exception may leave the library.
#pragma once
#include <exception>

namespace se {

// Run f. Return 0, or 1 if it throws, which means that memory ran out.
template <class F>
int run_guarded(F&& f) noexcept {
  try {
    f();
    return 0;
  } catch (const std::exception&) {
    return 1;
  }
}

}  // namespace se
