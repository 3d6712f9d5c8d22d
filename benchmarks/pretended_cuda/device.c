/* The device itself: its clock, its memory, the kernels that it knows by name, and what it answers. */
#define _GNU_SOURCE
#include "device.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>

EXPORT Counts pretended_counts;
EXPORT Speeds pretended_speeds = {.latency = 6.0, .kernel = 2.5};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

/* ---- Time ---- */

static uint64_t free_at; /* ns of CLOCK_MONOTONIC */
static double busy_us;

uint64_t now_ns(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

uint64_t device_free_at(void) { return free_at; }

void spend(double microseconds) {
  if (microseconds <= 0) return;
  uint64_t end = now_ns() + (uint64_t)(1000 * microseconds);
  while (now_ns() < end) continue;
}

void work(double microseconds) {
  busy_us += microseconds;
  if (!pretended_speeds.clock) return;
  uint64_t begin = now_ns() + (uint64_t)(1000 * pretended_speeds.latency);
  free_at = (free_at < begin ? begin : free_at) + (uint64_t)(1000 * microseconds);
}

void wait_for_device(void) {
  pretended_counts.waits++;
  if (!pretended_speeds.clock) return;
  uint64_t began = now_ns();
  while (now_ns() < free_at) continue;
  pretended_counts.waited_ns += now_ns() - began;
  spend(pretended_speeds.event);
}

/* The microseconds that the device has worked since the last call. */
EXPORT double pretended_take_busy(void) {
  double found = busy_us;
  busy_us = 0;
  return found;
}

/* ---- Memory: address space without pages, which reads as zeros. Nothing is given back; torch caches its blocks. ---- */

static struct {
  char *begin, *at;
  size_t bytes;
} areas[] = {[PINNED] = {.bytes = (size_t)16 << 30}, [DEVICE] = {.bytes = (size_t)60 << 30}};

void *take_memory(enum Place place, size_t bytes) {
  pthread_mutex_lock(&lock);
  if (!areas[place].begin) {
    void *made = mmap(0, areas[place].bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (made == MAP_FAILED) abort();
    areas[place].begin = areas[place].at = made;
  }
  char *found = areas[place].at;
  areas[place].at += (bytes + 511) & ~(size_t)511;
  if (areas[place].at > areas[place].begin + areas[place].bytes) {
    fprintf(stderr, "the pretended device is out of memory\n");
    abort();
  }
  pthread_mutex_unlock(&lock);
  return found;
}

enum Place place_of(const void *address) {
  for (enum Place place = PINNED; place <= DEVICE; place++) {
    const char *begin = areas[place].begin;
    if (begin && (const char *)address >= begin && (const char *)address < begin + areas[place].bytes) return place;
  }
  return HOST;
}

/* ---- Answers ---- */

EXPORT Answers pretended_answers[2];              /* to copies of 4 and of 8 bytes */
EXPORT uint64_t pretended_downloads[MOST_ANSWERS]; /* sizes of the last copies to the host, in order */
EXPORT uint64_t pretended_download_count;

static int64_t next_answer(Answers *given) {
  if (!given->count) return 0;
  int64_t place = given->next < given->count ? given->next++ : given->count - 1;
  return given->values[place];
}

void download(void *to, size_t bytes) {
  if (pretended_download_count < MOST_ANSWERS) pretended_downloads[pretended_download_count] = bytes;
  pretended_download_count++;
  memset(to, 0, bytes);
  if (bytes == 4) *(int32_t *)to = (int32_t)next_answer(&pretended_answers[0]);
  if (bytes == 8) *(int64_t *)to = next_answer(&pretended_answers[1]);
}

/* ---- Kernels, in a hash table by address: torch registers tens of thousands ---- */

typedef struct {
  const void *function;
  const char *name;
  double us; /* below 0: not looked up yet, or without a time of its own */
  int looked_up;
  uint64_t launches;
} Kernel;

#define SLOTS ((uint32_t)1 << 18)
static Kernel kernels[SLOTS];
static uint32_t kernel_count;

#define MOST_TIMES 400
static struct {
  char part[120];
  double us;
} times[MOST_TIMES];
static int time_count;

static Kernel *slot_of(const void *function) {
  uint64_t x = (uint64_t)function;
  uint32_t at = (uint32_t)(((x ^ x >> 17) * 0x9E3779B97F4A7C15u) >> 40) & (SLOTS - 1);
  while (kernels[at].function && kernels[at].function != function) at = (at + 1) & (SLOTS - 1);
  return &kernels[at];
}

void add_kernel(const void *function, const char *name) {
  pthread_mutex_lock(&lock);
  Kernel *slot = slot_of(function);
  if (!slot->function) {
    if (++kernel_count > SLOTS / 2) abort();
    *slot = (Kernel){.function = function, .name = strdup(name), .us = -1};
  }
  pthread_mutex_unlock(&lock);
}

void launch_kernel(const void *function, uint64_t *counter) {
  Kernel *kernel = slot_of(function);
  double us = -1;
  ++*counter;
  if (kernel->function) {
    kernel->launches++;
    if (!kernel->looked_up) {
      kernel->looked_up = 1;
      for (int i = 0; i < time_count && kernel->us < 0; i++)
        if (strstr(kernel->name, times[i].part)) kernel->us = times[i].us;
    }
    us = kernel->us;
  }
  work(us < 0 ? pretended_speeds.kernel : us);
  spend(pretended_speeds.launch);
}

/* Set the microseconds of the kernels whose names contain `part`, before their first launch. */
EXPORT void pretended_set_time(const char *part, double us) {
  if (time_count == MOST_TIMES) return;
  snprintf(times[time_count].part, sizeof times[0].part, "%s", part);
  times[time_count++].us = us;
}

/* Print every kernel that was launched since `pretended_clear`. */
EXPORT void pretended_report(void) {
  for (uint32_t i = 0; i < SLOTS; i++)
    if (kernels[i].launches) printf("%8lu  %s\n", (unsigned long)kernels[i].launches, kernels[i].name);
  fflush(stdout);
}

EXPORT void pretended_clear(void) {
  for (uint32_t i = 0; i < SLOTS; i++) kernels[i].launches = 0;
  memset(&pretended_counts, 0, sizeof pretended_counts);
  busy_us = 0;
}

/* A process that sets no answers, such as a rehearsal of the commands for a GPU, gets this one. */
__attribute__((constructor)) static void begin(void) {
  const char *given = getenv("PRETENDED_ANSWER");
  for (int i = 0; i < 2 && given; i++) pretended_answers[i] = (Answers){.values = {atoll(given)}, .count = 1};
}

/* ---- An H100, by the numbers of cudaDeviceAttr, which are those of CUdevice_attribute ---- */

int device_attribute(int attribute) {
  switch (attribute) {
    case 1: return 1024;       /* threads of a block */
    case 2: case 3: return 1024;
    case 4: return 64;
    case 5: return 2147483647; /* blocks of a grid */
    case 6: case 7: return 65535;
    case 8: return 49152;      /* shared memory of a block */
    case 10: return 32;        /* threads of a warp */
    case 12: return 65536;     /* registers of a block */
    case 13: return 1980000;   /* kHz */
    case 16: return 132;       /* multiprocessors */
    case 36: return 2619000;   /* kHz of the memory */
    case 37: return 5120;      /* bits of its bus */
    case 38: return 50 << 20;  /* bytes of the L2 cache */
    case 39: return 2048;      /* threads of a multiprocessor */
    case 41: return 1;         /* unified addresses */
    case 75: return 9;         /* compute capability */
    case 76: return 0;
    case 81: return 233472;    /* shared memory of a multiprocessor */
    case 82: return 65536;
    case 97: return 232448;    /* shared memory of a block that asks for it */
    default: return 0;
  }
}
