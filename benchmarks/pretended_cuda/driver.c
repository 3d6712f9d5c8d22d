/* The CUDA driver, as far as Triton and torch call it. */
#include <cuda.h>
#include <stdio.h>
#include <stdlib.h>

#include "device.h"

#define CALL EXPORT CUresult
#define DONE return CUDA_SUCCESS

static int context;

CALL cuInit(unsigned flags) { DONE; }
CALL cuDriverGetVersion(int *v) {
  *v = CUDA_VERSION;
  DONE;
}
CALL cuDeviceGet(CUdevice *device, int ordinal) {
  *device = 0;
  DONE;
}
CALL cuDeviceGetCount(int *n) {
  *n = 1;
  DONE;
}
CALL cuDeviceGetAttribute(int *value, CUdevice_attribute a, CUdevice device) {
  *value = device_attribute((int)a);
  DONE;
}
CALL cuCtxGetCurrent(CUcontext *c) {
  *c = (CUcontext)&context;
  DONE;
}
CALL cuCtxSetCurrent(CUcontext c) { DONE; }
CALL cuDevicePrimaryCtxRetain(CUcontext *c, CUdevice device) { return cuCtxGetCurrent(c); }
CALL cuDevicePrimaryCtxGetState(CUdevice device, unsigned *flags, int *active) {
  *flags = 0;
  *active = 1;
  DONE;
}
CALL cuCtxGetLimit(size_t *value, CUlimit limit) {
  *value = 0;
  DONE;
}
CALL cuCtxSetLimit(CUlimit limit, size_t value) { DONE; }
CALL cuGetErrorString(CUresult e, const char **text) {
  *text = "none";
  DONE;
}
CALL cuGetErrorName(CUresult e, const char **text) {
  *text = "none";
  DONE;
}
CALL cuModuleLoadData(CUmodule *module, const void *image) {
  *module = malloc(64);
  DONE;
}
CALL cuModuleGetFunction(CUfunction *function, CUmodule module, const char *name) {
  char text[300];
  snprintf(text, sizeof text, "triton:%s", name);
  *function = malloc(64);
  add_kernel(*function, text);
  DONE;
}
CALL cuFuncGetAttribute(int *value, CUfunction_attribute a, CUfunction function) {
  *value = a == CU_FUNC_ATTRIBUTE_MAX_THREADS_PER_BLOCK ? 1024 : 0;
  DONE;
}
CALL cuFuncSetAttribute(CUfunction function, CUfunction_attribute a, int value) { DONE; }
CALL cuFuncSetCacheConfig(CUfunction function, CUfunc_cache config) { DONE; }
CALL cuPointerGetAttribute(void *value, CUpointer_attribute a, CUdeviceptr p) {
  pretended_counts.pointer_queries++;
  *(CUdeviceptr *)value = p;
  DONE;
}
CALL cuLaunchKernelEx(const CUlaunchConfig *configuration, CUfunction function, void **arguments, void **extra) {
  launch_kernel(function, &pretended_counts.triton_launches);
  DONE;
}
CALL cuLaunchKernel(CUfunction function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz, unsigned shared,
                    CUstream s, void **arguments, void **extra) {
  launch_kernel(function, &pretended_counts.triton_launches);
  DONE;
}
CALL cuOccupancyMaxActiveBlocksPerMultiprocessor(int *n, CUfunction function, int block, size_t shared) {
  *n = 8;
  DONE;
}
