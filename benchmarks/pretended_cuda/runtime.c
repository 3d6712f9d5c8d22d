/* The CUDA runtime, as far as torch and gsplat call it in a training. */
#define _GNU_SOURCE
#include <cuda_runtime_api.h>
#include <dlfcn.h>
#include <stdlib.h>
#include <string.h>

#include "device.h"

#define CALL EXPORT cudaError_t
#define DONE return cudaSuccess

/* ---- Memory ---- */

CALL cudaMalloc(void **p, size_t n) {
  pretended_counts.allocations++;
  *p = take_memory(DEVICE, n);
  DONE;
}
CALL cudaMallocAsync(void **p, size_t n, cudaStream_t s) { return cudaMalloc(p, n); }
CALL cudaFree(void *p) { DONE; }
CALL cudaFreeAsync(void *p, cudaStream_t s) { DONE; }
CALL cudaHostAlloc(void **p, size_t n, unsigned flags) {
  pretended_counts.pinned_allocations++;
  *p = take_memory(PINNED, n);
  DONE;
}
CALL cudaFreeHost(void *p) { DONE; }
CALL cudaHostRegister(void *p, size_t n, unsigned flags) { DONE; }
CALL cudaHostUnregister(void *p) { DONE; }
CALL cudaMemGetInfo(size_t *unused, size_t *total) {
  *total = (size_t)80 << 30;
  *unused = (size_t)78 << 30;
  DONE;
}
CALL cudaPointerGetAttributes(struct cudaPointerAttributes *a, const void *p) {
  enum Place place = place_of(p);
  pretended_counts.pointer_queries++;
  memset(a, 0, sizeof *a);
  a->type = place == DEVICE ? cudaMemoryTypeDevice : place == PINNED ? cudaMemoryTypeHost : cudaMemoryTypeUnregistered;
  if (place != HOST) a->devicePointer = (void *)p;
  if (place == PINNED) a->hostPointer = (void *)p;
  DONE;
}
CALL cudaMemcpyAsync(void *to, const void *from, size_t n, enum cudaMemcpyKind kind, cudaStream_t s) {
  int onto = place_of(to) == DEVICE, out_of = place_of(from) == DEVICE;
  if (onto && !out_of) {
    pretended_counts.uploads++;
    work(n > 100000 ? 20 + (double)n / 25e3 : 2);
  } else if (out_of && !onto) {
    pretended_counts.downloads++;
    download(to, n);
    work(2);
    if (place_of(to) != PINNED) wait_for_device();
  } else {
    pretended_counts.device_copies++;
    work(2 + (double)n / 1.4e6);
  }
  spend(pretended_speeds.copy);
  DONE;
}
CALL cudaMemcpy(void *to, const void *from, size_t n, enum cudaMemcpyKind kind) {
  cudaMemcpyAsync(to, from, n, kind, 0);
  wait_for_device();
  DONE;
}
CALL cudaMemcpy2DAsync(void *to, size_t dp, const void *from, size_t sp, size_t w, size_t h, enum cudaMemcpyKind k, cudaStream_t s) { DONE; }
CALL cudaMemcpyPeerAsync(void *to, int td, const void *from, int fd, size_t n, cudaStream_t s) { DONE; }
CALL cudaMemcpyToSymbol(const void *symbol, const void *from, size_t n, size_t offset, enum cudaMemcpyKind kind) { DONE; }
CALL cudaMemsetAsync(void *p, int value, size_t n, cudaStream_t s) {
  pretended_counts.fills++;
  work(2 + (double)n / 2e6);
  spend(pretended_speeds.copy);
  DONE;
}
CALL cudaMemset(void *p, int value, size_t n) { return cudaMemsetAsync(p, value, n, 0); }
CALL cudaGetSymbolAddress(void **p, const void *symbol) {
  *p = take_memory(DEVICE, 4096);
  DONE;
}
CALL cudaDeviceGetDefaultMemPool(cudaMemPool_t *pool, int device) {
  *pool = (cudaMemPool_t)1;
  DONE;
}
CALL cudaMemPoolGetAttribute(cudaMemPool_t pool, enum cudaMemPoolAttr a, void *value) {
  *(uint64_t *)value = 0;
  DONE;
}
CALL cudaMemPoolSetAttribute(cudaMemPool_t pool, enum cudaMemPoolAttr a, void *value) { DONE; }

/* ---- The device ---- */

CALL cudaGetDeviceCount(int *n) {
  *n = 1;
  DONE;
}
CALL cudaGetDevice(int *device) {
  *device = 0;
  DONE;
}
CALL cudaSetDevice(int device) { DONE; }
CALL cudaGetDeviceProperties(struct cudaDeviceProp *p, int device) {
  memset(p, 0, sizeof *p);
  strcpy(p->name, "H100 (pretended)");
  p->major = device_attribute(75);
  p->multiProcessorCount = device_attribute(16);
  p->warpSize = 32;
  p->maxThreadsPerBlock = p->maxThreadsDim[0] = p->maxThreadsDim[1] = 1024;
  p->maxThreadsDim[2] = 64;
  p->maxThreadsPerMultiProcessor = device_attribute(39);
  p->sharedMemPerBlock = (size_t)device_attribute(8);
  p->sharedMemPerBlockOptin = (size_t)device_attribute(97);
  p->sharedMemPerMultiprocessor = (size_t)device_attribute(81);
  p->regsPerBlock = p->regsPerMultiprocessor = 65536;
  p->totalGlobalMem = (size_t)80 << 30;
  p->maxGridSize[0] = 2147483647;
  p->maxGridSize[1] = p->maxGridSize[2] = 65535;
  p->l2CacheSize = device_attribute(38);
  p->textureAlignment = 512;
  p->unifiedAddressing = p->managedMemory = p->cooperativeLaunch = 1;
  p->maxBlocksPerMultiProcessor = 32;
  p->memoryBusWidth = device_attribute(37);
  DONE;
}
CALL cudaDeviceGetAttribute(int *value, enum cudaDeviceAttr a, int device) {
  *value = device_attribute((int)a);
  DONE;
}
CALL cudaDeviceGetStreamPriorityRange(int *least, int *greatest) {
  *least = 0;
  *greatest = -5;
  DONE;
}
CALL cudaDeviceGetPCIBusId(char *text, int n, int device) {
  strncpy(text, "0000:00:04.0", (size_t)n);
  DONE;
}
CALL cudaDeviceCanAccessPeer(int *can, int a, int b) {
  *can = 0;
  DONE;
}
CALL cudaDeviceSynchronize(void) {
  wait_for_device();
  DONE;
}
CALL cudaDriverGetVersion(int *v) {
  *v = CUDART_VERSION;
  DONE;
}
CALL cudaRuntimeGetVersion(int *v) {
  *v = CUDART_VERSION;
  DONE;
}
CALL cudaGetLastError(void) { DONE; }
CALL cudaPeekAtLastError(void) { DONE; }
EXPORT const char *cudaGetErrorName(cudaError_t e) { return "none"; }
EXPORT const char *cudaGetErrorString(cudaError_t e) { return "none"; }
CALL cudaProfilerStart(void) { DONE; }
CALL cudaProfilerStop(void) { DONE; }

static int succeed(void) { return 0; }

CALL cudaGetDriverEntryPointByVersion(const char *name, void **function, unsigned version, unsigned long long flags,
                                      enum cudaDriverEntryPointQueryResult *result) {
  void *found = dlsym(RTLD_DEFAULT, name);
  *function = found ? found : (void *)succeed;
  if (result) *result = cudaDriverEntryPointSuccess;
  DONE;
}

/* ---- Streams and events ---- */

CALL cudaStreamCreate(cudaStream_t *s) {
  *s = malloc(64);
  DONE;
}
CALL cudaStreamCreateWithPriority(cudaStream_t *s, unsigned flags, int priority) { return cudaStreamCreate(s); }
CALL cudaStreamDestroy(cudaStream_t s) { DONE; }
CALL cudaStreamSynchronize(cudaStream_t s) {
  wait_for_device();
  DONE;
}
CALL cudaStreamQuery(cudaStream_t s) { DONE; }
CALL cudaStreamWaitEvent(cudaStream_t s, cudaEvent_t e, unsigned flags) { DONE; }
CALL cudaStreamGetPriority(cudaStream_t s, int *priority) {
  *priority = 0;
  DONE;
}
CALL cudaLaunchHostFunc(cudaStream_t s, cudaHostFn_t f, void *data) {
  f(data);
  DONE;
}
CALL cudaThreadExchangeStreamCaptureMode(enum cudaStreamCaptureMode *mode) { DONE; }
CALL cudaStreamIsCapturing(cudaStream_t s, enum cudaStreamCaptureStatus *status) {
  *status = cudaStreamCaptureStatusNone;
  DONE;
}
CALL cudaStreamGetCaptureInfo(cudaStream_t s, enum cudaStreamCaptureStatus *status, unsigned long long *id, cudaGraph_t *graph,
                              const cudaGraphNode_t **nodes, const cudaGraphEdgeData **edges, size_t *n) {
  *status = cudaStreamCaptureStatusNone;
  if (id) *id = 0;
  if (nodes) *nodes = 0;
  if (n) *n = 0;
  DONE;
}

typedef struct {
  uint64_t at; /* ns */
} Event;

CALL cudaEventCreateWithFlags(cudaEvent_t *e, unsigned flags) {
  *e = calloc(1, 64);
  DONE;
}
CALL cudaEventCreate(cudaEvent_t *e) { return cudaEventCreateWithFlags(e, 0); }
CALL cudaEventDestroy(cudaEvent_t e) {
  free(e);
  DONE;
}
CALL cudaEventRecord(cudaEvent_t e, cudaStream_t s) {
  uint64_t now = now_ns();
  pretended_counts.events++;
  ((Event *)e)->at = device_free_at() > now ? device_free_at() : now;
  spend(pretended_speeds.event);
  DONE;
}
CALL cudaEventRecordWithFlags(cudaEvent_t e, cudaStream_t s, unsigned flags) { return cudaEventRecord(e, s); }
CALL cudaEventQuery(cudaEvent_t e) {
  pretended_counts.event_queries++;
  return pretended_speeds.clock && ((Event *)e)->at > now_ns() ? cudaErrorNotReady : cudaSuccess;
}
CALL cudaEventSynchronize(cudaEvent_t e) {
  uint64_t began = now_ns();
  pretended_counts.waits++;
  while (pretended_speeds.clock && ((Event *)e)->at > now_ns()) continue;
  if (pretended_speeds.clock) pretended_counts.waited_ns += now_ns() - began;
  DONE;
}
CALL cudaEventElapsedTime(float *ms, cudaEvent_t a, cudaEvent_t b) {
  *ms = (float)(((double)((Event *)b)->at - (double)((Event *)a)->at) / 1e6);
  DONE;
}

/* ---- Kernels ---- */

EXPORT void **__cudaRegisterFatBinary(void *binary) {
  static void *handle;
  return &handle;
}
EXPORT void __cudaRegisterFatBinaryEnd(void **handle) {}
EXPORT void __cudaUnregisterFatBinary(void **handle) {}
EXPORT char __cudaInitModule(void **handle) { return 0; }
EXPORT void __cudaRegisterFunction(void **handle, const char *function, char *device, const char *name, int limit, void *a, void *b, void *c,
                                   void *d, int *e) {
  add_kernel(function, name);
}
EXPORT void __cudaRegisterVar(void **handle, char *v, char *address, const char *name, int external, size_t n, int constant, int global) {}
EXPORT cudaError_t __cudaGetKernel(cudaKernel_t *kernel, const void *function) {
  *kernel = (cudaKernel_t)function;
  DONE;
}

static __thread struct {
  dim3 grid, block;
  size_t shared;
  void *stream;
} configuration;

EXPORT unsigned __cudaPushCallConfiguration(dim3 grid, dim3 block, size_t shared, void *stream) {
  configuration.grid = grid;
  configuration.block = block;
  configuration.shared = shared;
  configuration.stream = stream;
  return 0;
}
EXPORT cudaError_t __cudaPopCallConfiguration(dim3 *grid, dim3 *block, size_t *shared, void *stream) {
  *grid = configuration.grid;
  *block = configuration.block;
  *shared = configuration.shared;
  *(void **)stream = configuration.stream;
  DONE;
}
CALL cudaLaunchKernel(const void *function, dim3 grid, dim3 block, void **arguments, size_t shared, cudaStream_t s) {
  launch_kernel(function, &pretended_counts.launches);
  DONE;
}
EXPORT cudaError_t __cudaLaunchKernel(cudaKernel_t kernel, dim3 grid, dim3 block, void **arguments, size_t shared, cudaStream_t s) {
  return cudaLaunchKernel(kernel, grid, block, arguments, shared, s);
}
CALL cudaLaunchKernelExC(const cudaLaunchConfig_t *configuration, const void *function, void **arguments) {
  launch_kernel(function, &pretended_counts.launches);
  DONE;
}
CALL cudaFuncGetAttributes(struct cudaFuncAttributes *a, const void *function) {
  memset(a, 0, sizeof *a);
  a->ptxVersion = a->binaryVersion = 90;
  a->maxThreadsPerBlock = 1024;
  a->numRegs = 32;
  a->maxDynamicSharedSizeBytes = device_attribute(97);
  DONE;
}
CALL cudaFuncSetAttribute(const void *function, enum cudaFuncAttribute a, int value) { DONE; }
CALL cudaOccupancyMaxActiveBlocksPerMultiprocessorWithFlags(int *n, const void *function, int block, size_t shared, unsigned flags) {
  *n = 8;
  DONE;
}
