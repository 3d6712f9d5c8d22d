/* cuBLAS and cuSOLVER in float32 and float64, as far as torch calls them for the matrices of a training. */
#include <stdlib.h>

#include "device.h"

static int call(void) {
  pretended_counts.linear_algebra++;
  work(8);
  spend(pretended_speeds.launch);
  return 0;
}

#define WORKS(name) EXPORT int name(void) { return call(); }
#define NOTHING(name) EXPORT int name(void) { return 0; }
#define MAKES(name) EXPORT int name(void **made) { *made = malloc(64); return 0; }
#define BOTH(begin, end) WORKS(begin##S##end) WORKS(begin##D##end)

MAKES(cublasCreate_v2) NOTHING(cublasDestroy_v2) NOTHING(cublasSetStream_v2) NOTHING(cublasSetWorkspace_v2)
NOTHING(cublasSetMathMode) NOTHING(cublasSetPointerMode_v2)
EXPORT int cublasGetMathMode(void *handle, int *mode) { *mode = 0; return 0; }
EXPORT int cublasGetPointerMode_v2(void *handle, int *mode) { *mode = 0; return 0; }

BOTH(cublas, gemm_v2) BOTH(cublas, gemv_v2) BOTH(cublas, dot_v2) BOTH(cublas, gemmBatched) BOTH(cublas, gemmStridedBatched)
BOTH(cublas, trsm_v2) BOTH(cublas, trsmBatched) BOTH(cublas, getrfBatched) BOTH(cublas, getrsBatched) BOTH(cublas, geqrfBatched)
WORKS(cublasGemmEx) WORKS(cublasSgemmEx) WORKS(cublasGemmStridedBatchedEx) WORKS(cublasDotEx)

MAKES(cublasLtCreate) MAKES(cublasLtMatmulDescCreate) MAKES(cublasLtMatmulPreferenceCreate) MAKES(cublasLtMatrixLayoutCreate)
NOTHING(cublasLtMatmulDescDestroy) NOTHING(cublasLtMatmulDescSetAttribute) NOTHING(cublasLtMatmulPreferenceDestroy)
NOTHING(cublasLtMatmulPreferenceSetAttribute) NOTHING(cublasLtMatrixLayoutDestroy) NOTHING(cublasLtMatrixLayoutSetAttribute)
NOTHING(cublasLtGetVersion) WORKS(cublasLtMatmul)
EXPORT int cublasLtMatmulAlgoGetHeuristic(void *handle, void *work, void *a, void *b, void *c, void *d, void *preference, int wanted,
                                          void *results, int *found) {
  *found = 1;
  return 0;
}

MAKES(cusolverDnCreate) NOTHING(cusolverDnDestroy) NOTHING(cusolverDnSetStream)
BOTH(cusolverDn, getrf) BOTH(cusolverDn, getrs) BOTH(cusolverDn, potrf) BOTH(cusolverDn, potrs)

#define NO_BUFFER(name) \
  EXPORT int name(void *handle, int m, int n, void *a, int stride, int *bytes) { *bytes = 0; return 0; }
NO_BUFFER(cusolverDnSgetrf_bufferSize) NO_BUFFER(cusolverDnDgetrf_bufferSize)
NO_BUFFER(cusolverDnSpotrf_bufferSize) NO_BUFFER(cusolverDnDpotrf_bufferSize)
