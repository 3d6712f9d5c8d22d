// The memory of the WebAssembly module of the codec, in place of a standard library's: it is taken upwards, and released down to a place.
// What the C++ of the codec takes is released with the block that its caller took before.
#include <cstddef>
#include <cstdint>
#include <new>

extern "C" unsigned char __heap_base;  // where the linker ends its own data

namespace {
constexpr size_t kPage = 65536, kEdge = 16;
uintptr_t top = reinterpret_cast<uintptr_t>(&__heap_base);
}  // namespace

// Return `size` bytes at a multiple of 16, or NULL.
extern "C" __attribute__((visibility("default"))) void* take(size_t size) {
  const uintptr_t at = (top + kEdge - 1) / kEdge * kEdge, end = at + size;
  const size_t here = __builtin_wasm_memory_size(0) * kPage;
  if (end < at) return nullptr;
  if (end > here && __builtin_wasm_memory_grow(0, (end - here + kPage - 1) / kPage) == SIZE_MAX) return nullptr;
  top = end;
  return reinterpret_cast<void*>(at);
}
// Release what was taken at `at` and everything after it.
extern "C" __attribute__((visibility("default"))) void release(void* at) { top = reinterpret_cast<uintptr_t>(at); }

void* operator new(size_t size) {
  void* found = take(size);
  if (!found) __builtin_trap();
  return found;
}
void operator delete(void*) noexcept {}
void operator delete(void*, size_t) noexcept {}
