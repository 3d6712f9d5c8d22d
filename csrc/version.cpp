// SE_ABI_VERSION comes from the build, which reads ABI_VERSION in src/scene_experts/native/api.py.
#include "se_api.h"

SE_EXPORT int32_t se_abi_version(void) { return SE_ABI_VERSION; }
