/* NVRTC, by which torch compiles a few kernels when they are first used. A library of its own: torch looks for it by its file's name. */
#include <cuda.h>
#include <stdlib.h>

#include "device.h"

#define COMPILER EXPORT int

COMPILER nvrtcVersion(int *major, int *minor) {
  *major = CUDA_VERSION / 1000;
  *minor = CUDA_VERSION % 1000 / 10;
  return 0;
}
COMPILER nvrtcGetNumSupportedArchs(int *n) {
  *n = 1;
  return 0;
}
COMPILER nvrtcGetSupportedArchs(int *found) {
  *found = 90;
  return 0;
}
COMPILER nvrtcCreateProgram(void **program, const char *text, const char *name, int n, const char **headers, const char **names) {
  *program = malloc(64);
  return 0;
}
COMPILER nvrtcDestroyProgram(void **program) { return 0; }
COMPILER nvrtcCompileProgram(void *program, int n, const char **options) { return 0; }
COMPILER nvrtcAddNameExpression(void *program, const char *name) { return 0; }
COMPILER nvrtcGetLoweredName(void *program, const char *name, const char **lowered) {
  *lowered = "compiled by torch";
  return 0;
}

static int size_of(void *program, size_t *bytes) {
  *bytes = 1;
  return 0;
}
static int text_of(void *program, char *to) {
  *to = 0;
  return 0;
}

COMPILER nvrtcGetPTXSize(void *program, size_t *bytes) { return size_of(program, bytes); }
COMPILER nvrtcGetPTX(void *program, char *to) { return text_of(program, to); }
COMPILER nvrtcGetCUBINSize(void *program, size_t *bytes) { return size_of(program, bytes); }
COMPILER nvrtcGetCUBIN(void *program, char *to) { return text_of(program, to); }
COMPILER nvrtcGetProgramLogSize(void *program, size_t *bytes) { return size_of(program, bytes); }
COMPILER nvrtcGetProgramLog(void *program, char *to) { return text_of(program, to); }
