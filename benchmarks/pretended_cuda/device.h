/* A CUDA device that does nothing, and counts what it is asked for. */
#ifndef PRETENDED_DEVICE_H
#define PRETENDED_DEVICE_H

#include <stddef.h>
#include <stdint.h>

#define EXPORT __attribute__((visibility("default")))

/* What the host asked of the device. Python reads it (`counts.py`), so the order is kept there too. */
typedef struct {
  uint64_t launches;        /* kernels of torch and gsplat */
  uint64_t triton_launches; /* kernels of Triton */
  uint64_t uploads;         /* copies from the host to the device */
  uint64_t downloads;       /* copies from the device to the host */
  uint64_t device_copies;
  uint64_t fills;
  uint64_t waits; /* the host waits for a stream, an event or a copy */
  uint64_t events;
  uint64_t event_queries;
  uint64_t allocations; /* of the device's memory; torch caches them */
  uint64_t pinned_allocations;
  uint64_t linear_algebra; /* calls of cuBLAS and cuSOLVER */
  uint64_t pointer_queries;
  uint64_t waited_ns; /* time that the host waited for the device's clock */
} Counts;

/* The numbers that copies of one size bring to the host, in order. The last one repeats. */
#define MOST_ANSWERS 64
typedef struct {
  int64_t values[MOST_ANSWERS];
  int64_t count, next;
} Answers;

/* Speeds, in microseconds. They matter if `clock` is set: then a wait takes until the device's clock has passed. */
typedef struct {
  double launch;  /* the driver's time for a launch, spent by the host */
  double copy;    /* ... for a copy or a fill */
  double event;   /* ... for an event or a wait */
  double latency; /* from a launch to the begin of its kernel */
  double kernel;  /* a kernel without a time of its own */
  int64_t clock;
} Speeds;

extern Counts pretended_counts;
extern Speeds pretended_speeds;

enum Place { HOST, PINNED, DEVICE };

void *take_memory(enum Place place, size_t bytes);
enum Place place_of(const void *address);

void add_kernel(const void *function, const char *name);
void launch_kernel(const void *function, uint64_t *counter);

void download(void *to, size_t bytes); /* what a copy to the host delivers */
void work(double microseconds);        /* the device does something */
void spend(double microseconds);       /* the host does something in the driver */
void wait_for_device(void);
uint64_t now_ns(void);
uint64_t device_free_at(void); /* when the work so far ends, ns */
int device_attribute(int attribute);

#endif
