// Loaded before torch (LD_PRELOAD): autograd asks the device of every tensor for a guard, and a torch without CUDA has none.
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <optional>

namespace {
c10::impl::DeviceGuardImplRegistrar registered(c10::DeviceType::CUDA, new c10::impl::NoOpDeviceGuardImpl<c10::DeviceType::CUDA>());
}

namespace at::accelerator {
__attribute__((visibility("default"))) std::optional<c10::DeviceType> getAccelerator(bool) { return std::nullopt; }
__attribute__((visibility("default"))) bool isAccelerator(c10::DeviceType) { return false; }
}  // namespace at::accelerator
