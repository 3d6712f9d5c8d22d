// The C interface of the native library: every exported function and every structure that crosses it.
//
// src/scene_experts/native/api.py declares the same for Python, and tests/unit/native/test_api.py holds the two equal. After a change
// here, change api.py and raise its ABI_VERSION. The build compiles that number into se_abi_version(), and Python refuses a library
// whose number differs.
//
// Arrays are contiguous and row-major. `float` is 32 bits. A pointer may be null only where its comment says so. Functions that return
// int32_t return 0 on success and 1 when memory runs out, unless their comment says more. `threads` is the largest number of threads used, including the caller.
//
// Symbols: A anchors in view, N rows of a table, K Gaussians per anchor, F feature channels, E experts, k experts per anchor (0: dense),
// H hidden units, L middle layers, D inputs of the first layer, M Gaussians.
#ifndef SE_API_H
#define SE_API_H

#include <stdint.h>

#ifdef __cplusplus
#define SE_EXTERN_C extern "C"
#else
#define SE_EXTERN_C
#endif
#if defined(_WIN32)
#define SE_EXPORT SE_EXTERN_C __declspec(dllexport)
#else
#define SE_EXPORT SE_EXTERN_C __attribute__((visibility("default")))
#endif

// ---- Library --------------------------------------------------------------------------------------------------------------------

// Return the number of this interface, ABI_VERSION of api.py.
SE_EXPORT int32_t se_abi_version(void);

// Run `chunks` chunks of independent multiply-adds and return how many single multiply-adds that was. For benchmarks.
SE_EXPORT double se_benchmark_multiply_adds(int64_t chunks, int32_t threads);

// ---- Rasteriser -----------------------------------------------------------------------------------------------------------------

typedef struct {
  float view[12];  // the rows of [R | t], world to camera
  float fx, fy, cx, cy, near_plane;
  int32_t width, height;  // pixels
} SeCamera;

typedef struct {
  SeCamera camera;
  int32_t antialias, threads;
  int64_t m;                                                 // M
  const float *means, *quats, *scales, *opacities, *colors;  // [M, 3] [M, 4] [M, 3] [M] [M, 3]
  const float* background;                                   // [3]
  float *image, *alpha, *depth;                              // output: [height, width, 3] [height, width] [height, width]
  int32_t* radii;                                            // output: [M], pixels; 0 outside of the image
} SeRasterForward;

typedef struct {
  int32_t deterministic, threads;
  int32_t absolute;  // 1: d_mean2d is the sum over pixels of the absolute values of a pixel's gradient, for each axis
  const float *means, *quats, *scales, *opacities, *colors;  // those of the forward pass
  const float* background;
  const float *g_image, *g_alpha, *g_depth;                                                // gradients of the outputs; null: zero
  float *d_means, *d_quats, *d_scales, *d_opacities, *d_colors, *d_mean2d, *d_background;  // output; d_mean2d [M, 2], in NDC units
} SeRasterBackward;

// Render. With `state`, *state holds what the backward pass needs; pass it to se_raster_release once. Null: keep nothing.
SE_EXPORT int32_t se_raster_forward(const SeRasterForward* call, void** state);
SE_EXPORT int32_t se_raster_backward(void* state, const SeRasterBackward* call);
SE_EXPORT void se_raster_release(void* state);
// visible [m]: 1 where an unrotated Gaussian at means [m, 3] with scales [m, 3] would be drawn, else 0.
SE_EXPORT void se_raster_find_visible(const SeCamera* camera, const float* means, const float* scales, int64_t m, uint8_t* visible,
                                      int32_t threads);
// For benchmarks. counts [3]: visible Gaussians, (Gaussian, tile) pairs, (Gaussian, block) pairs drawn. seconds [5]: time of each stage.
SE_EXPORT void se_raster_count(const void* state, int64_t* counts, double* seconds);

// ---- Decode of anchors ----------------------------------------------------------------------------------------------------------

typedef struct {
  const float *router_w, *router_b;  // [E, F] or [E, F + 3], [E]; null without a router, or if the caller routes
  const float *w1, *b1;              // [E, H, D] [E, H]
  const float *middle_w, *middle_b;  // [E, L, H, H] [E, L, H]; null if L = 0
  const float *w2, *b2;              // [E, out, H] [E, out]
  float* gates;           // [A, E], softmax over all logits; null if E = 1. Where the caller routes: input, the mixture weights if k = 0
  int64_t* chosen;        // [A, k]; null if k = 0. Input where the caller routes
  float* chosen_weight;   // [A, k], mixture weights of the chosen experts; null if k = 0. Input where the caller routes
  float *d_router_w, *d_router_b, *d_w1, *d_b1, *d_middle_w, *d_middle_b, *d_w2, *d_b2;  // gradients; null like the tensors
  const float* d_gates;                                                                  // [A, E]; null: zero
  float* d_weight;  // output where the caller routes: [A, k], or [A, E] if k = 0; null otherwise
  int64_t E, k, H, L, out;                                                               // out: outputs of an expert
  int64_t distance, position;  // 1 if the first layer sees the distance; 1 if the router sees the position
} SeDecodeHead;

typedef struct {
  const int64_t* rows;                                                         // [A], rows of the table
  const float *xyz, *feature, *log_scaling, *offsets, *camera;                 // [N, 3] [N, F] [N, 6] [N, K, 3] [3]
  float* raw;                                                                  // [A, K], raw opacities
  int64_t* starts;                                                             // [se_decode_chunks(A) + 1], a chunk's first Gaussian
  float *means, *quats, *scales, *opacities, *colors;                          // [M, 3] [M, 4] [M, 3] [M] [M, 3]
  float* per_length;                                                           // [M], 1 / length of the mixed quaternion
  int64_t* source;                                                             // [M], row * K + slot
  const float *d_means, *d_quats, *d_scales, *d_opacities, *d_colors, *d_raw;  // null: zero
  float *d_feature, *d_log_scaling, *d_offsets;                                // [N, ...]
  const float *steps, *factors;  // [F + 6 + 3 K] [N]: values are rounded to multiples of steps times the row's factor; null: they are not
  const uint8_t* slots;          // [N, K]: slots with 0 are not drawn; null: all may be
  float* d_log_steps;            // [F + 6 + 3 K], of the logarithms of the steps; null without steps
  double origin;                 // log-scalings are rounded to multiples from here on
  int64_t A, N, K, F, threads;
  int64_t ascending;      // 1 if `rows` ascend: the backward pass then writes zeros to all other rows of the table
  int64_t frozen;         // 1 if gates, chosen and chosen_weight are given, for all N rows
  double extent;          // the router sees xyz / extent
  SeDecodeHead heads[3];  // opacity, covariance, colour
} SeDecode;

// Return the number of chunks that A anchors make.
SE_EXPORT int64_t se_decode_chunks(int64_t anchors);
// Fill gates, chosen and chosen_weight.
SE_EXPORT int32_t se_decode_route(const SeDecode* call);
// Route (unless frozen) and fill raw and starts; the last entry of starts is M, the number of positive opacities.
SE_EXPORT int32_t se_decode_begin(const SeDecode* call);
// Fill the M Gaussians in the order of (anchor, slot).
SE_EXPORT int32_t se_decode_emit(const SeDecode* call);
// Fill all gradients.
SE_EXPORT int32_t se_decode_backward(const SeDecode* call);

// ---- Losses ---------------------------------------------------------------------------------------------------------------------

// out[0] = mean |x - y| and out[1] = 1 - mean SSIM of two images [H, W, 3]; gradient [H, W, 3] (or null) =
// d (weight_l1 out[0] + weight_ssim out[1]) / dx.
SE_EXPORT int32_t se_photometric_loss(const float* x, const float* y, int64_t H, int64_t W, float weight_l1, float weight_ssim,
                                      int32_t threads, float* gradient, double* out);
// Return the number of partial sums of a sum over `count` values. The caller adds them in order, which gives the same bits for every
// number of threads.
SE_EXPORT int64_t se_sum_chunks(int64_t count);
// partial [se_sum_chunks(count)]: sums of sx sy sz over scales [count, 3].
SE_EXPORT void se_volume_forward(const float* scales, int64_t count, double* partial, int32_t threads);
// gradient [count, 3] = upstream times the gradient of the sum.
SE_EXPORT void se_volume_backward(const float* scales, int64_t count, float upstream, float* gradient, int32_t threads);
// partial [se_sum_chunks(count)]: sums of max(0, tau - raw) over raw [count].
SE_EXPORT void se_hinge_forward(const float* raw, int64_t count, float tau, double* partial, int32_t threads);
SE_EXPORT void se_hinge_backward(const float* raw, int64_t count, float tau, float upstream, float* gradient, int32_t threads);

// ---- Adam -----------------------------------------------------------------------------------------------------------------------

typedef struct {
  float* value;
  const float* gradient;
  float *first, *second;   // moments
  const int64_t* rows;     // [count], the rows to update; null: all
  int64_t count, width;    // with rows: their number and the elements of one row; else all elements and 1
  double step_size, root;  // learning rate / (1 - beta1^t), sqrt(1 - beta2^t)
} SeAdamTensor;

// Update `count` tensors by one step of Adam. Return the number of the first tensor of which a new value or moment is not finite, or -1.
SE_EXPORT int64_t se_adam_step(const SeAdamTensor* tensors, int64_t count, double beta1, double beta2, double eps, int32_t threads);

// ---- Spherical harmonics --------------------------------------------------------------------------------------------------------

// out [count, 3]: colours of Gaussians at means [count, 3] seen from position [3]. dc [N, 3] and rest [N, width, 3] are a table, of which
// rows [count] (null: all, count = N) belong to the means.
SE_EXPORT void se_sh_forward(const float* means, const float* dc, const float* rest, const int64_t* rows, int64_t count, int64_t width,
                             int32_t degree, const float* position, float* out, int32_t threads);
// Gradients of the means, and, at `rows` only, of dc and rest, from the colours [count, 3] and their gradient.
SE_EXPORT void se_sh_backward(const float* means, const float* dc, const float* rest, const int64_t* rows, const float* position,
                              const float* colors, const float* upstream, float* d_means, float* d_dc, float* d_rest, int64_t count,
                              int64_t width, int32_t degree, int32_t threads);

// ---- Graph of anchors and hash grid ---------------------------------------------------------------------------------------------

// Invert the graph of neighbours found [A, k] (-1: none). The edges a * k + j that lead to point v are known[start[v]] up to, but not
// including, known[start[v + 1]]. start [A + 1], known [A k].
SE_EXPORT void se_graph_reverse(const int64_t* found, int64_t A, int64_t k, int32_t* start, int32_t* known);
// out [A, F] = feature + share * sum over neighbours of weight (feature - least) of the neighbour; least [A, F], the minima over the points
// that know a point.
SE_EXPORT void se_graph_forward(const float* feature, const int64_t* found, const float* weight, const int32_t* start, const int32_t* known,
                                int64_t A, int64_t k, int64_t F, float share, float* least, float* out, int32_t threads);
// out [A, F]: the gradient of the features; h and shared [A, F] are scratch memory.
SE_EXPORT void se_graph_backward(const float* feature, const float* least, const float* grad, const int64_t* found, const float* weight,
                                 const int32_t* start, const int32_t* known, int64_t A, int64_t k, int64_t F, float share, float* h,
                                 float* shared, float* out, int32_t threads);
// out [A, levels, features]: features of points unit [A, 3] in the unit cube; cells and rows [levels]: cells along an axis, table rows.
SE_EXPORT void se_grid_forward(const float* table, const float* unit, const int64_t* cells, const int64_t* rows, int64_t A, int64_t levels,
                               int64_t features, float* out, int32_t threads);
// Add the gradient of the table to out [sum of rows, features].
SE_EXPORT void se_grid_backward(const float* unit, const float* grad, const int64_t* cells, const int64_t* rows, int64_t A, int64_t levels,
                                int64_t features, float* out, int32_t threads);

// ---- Density control ------------------------------------------------------------------------------------------------------------

// Add one view to visits [N] and opacity [N]: rows [count], raw opacities [count, K].
SE_EXPORT void se_observe_rows(const int64_t* rows, const float* raw, int64_t count, int64_t K, float* visits, float* opacity,
                               int32_t threads);
// Add the norms of gradient [count, 2] and 1 to grad and counted at source [count], where radii [count] is positive.
SE_EXPORT void se_observe_drawn(const int32_t* radii, const float* gradient, const int64_t* source, int64_t count, float* grad,
                                float* counted, int32_t threads);
// means [count, 3] += Sigma eta size sigmoid(-sharpness (opacity - faint)), with eta [count, 3].
SE_EXPORT void se_mcmc_add_noise(float* means, const float* quats, const float* log_scales, const float* raw_opacity, const float* eta,
                                 int64_t count, float size, float sharpness, float faint, int32_t threads);

// ---- Depth of photographs -------------------------------------------------------------------------------------------------------

typedef struct {
  const float* grey;        // [P], the pixels of all views: grey levels from 0 to 255; below 0 where a pixel does not count
  const int64_t* start;     // [views + 1], the first pixel of each view
  const int32_t* size;      // [views, 2], width and height, pixels
  const double* camera;     // [views, 16]: the rows of [R | t], world to camera; fx, fy, cx, cy, pixels
  const int32_t* compared;  // [views, k], the views that a view is compared with; -1: none
  const double* planes;     // [views, 2], inverse depth of the first and the last plane; a view whose second is 0 is left out
  float *inverse, *score;   // [P], inverse depth (0: unknown), and ZNCC (-1: unknown)
  int64_t views, k, count;  // count: planes of a view, at least 3
  int32_t threads;
} SeSweep;

// Fill inverse and score of each view by a plane sweep.
SE_EXPORT int32_t se_sweep_match(const SeSweep* call);
// agree [P]: in how many of the views others[first[v]] to others[first[v + 1] - 1] the depth of a pixel of view v is found again, within
// the share `tolerance`, at a score above `weak`; 0 where the pixel's own score is not above `strong`.
SE_EXPORT int32_t se_sweep_agree(const SeSweep* call, const int64_t* first, const int32_t* others, float strong, float weak,
                                 double tolerance, int32_t* agree);
// For points [count, 3]: the number of views in which a point lies in front of the view's depth by more than the share `front`, and in
// which it lies within the share `near_by` of it. Pixels whose inverse depth is 0 say nothing.
SE_EXPORT int32_t se_sweep_compare(const SeSweep* call, const double* points, int64_t count, double front, double near_by,
                                   int32_t* before, int32_t* on);

// ---- Entropy coder of compact files -----------------------------------------------------------------------------------------------
// docs/compact-file.md says what is coded. An operation is a share [start, start + width) of 2^15 as start << 16 | width. Readers return
// 2 where the words fit no symbols; they never read beyond the words.

typedef struct {
  const uint16_t* words;           // [count]
  int64_t count, at, operations;   // words, and how many words and operations were read
  int64_t state[4];                // of the coder
} SeCodeReader;

// Append the operations of values [count], expected near mean [count] (1/8 of a step) with a spread of scale [count] (1/8 of an octave, 0 to
// 127, from 1/16 of a step); room for 6 count operations. Return how many were written.
SE_EXPORT int64_t se_code_symbols(const int32_t* values, const int32_t* mean, const int32_t* scale, int64_t count, uint32_t* operations);
// The operations [count] of bits [count] with odds [count] of a one: 2^((odds - 64) / 8), odds 0 to 127.
SE_EXPORT void se_code_bits(const uint8_t* bits, const int32_t* odds, int64_t count, uint32_t* operations);
// The words of operations [count]; room for count + 8. Return how many words were written.
SE_EXPORT int64_t se_code_pack(const uint32_t* operations, int64_t count, uint16_t* words);
// Set at, operations and state to the begin of the words.
SE_EXPORT int32_t se_code_start(SeCodeReader* reader);
SE_EXPORT int32_t se_code_read(SeCodeReader* reader, const int32_t* mean, const int32_t* scale, int64_t count, int32_t* values);
SE_EXPORT int32_t se_code_read_bits(SeCodeReader* reader, const int32_t* odds, int64_t count, uint8_t* bits);
// Operations of the octree of distinct ascending Morton keys [count] of 3 depth bits. Return their number, of which at most `capacity` were
// written; -1: out of memory.
SE_EXPORT int64_t se_code_cells(const int64_t* keys, int64_t count, int32_t depth, uint32_t* operations, int64_t capacity);
SE_EXPORT int32_t se_code_read_cells(SeCodeReader* reader, int32_t depth, int64_t count, int64_t* keys);
// mean and scale [count] of a channel from inputs [D] of [count] each: weights [2, D] of both, numbers [4] = bias and shift of both, classes
// [count] of the anchors (a step is 2^class times the channel's).
SE_EXPORT void se_code_predict(const int16_t** inputs, const int8_t* weights, const int32_t* numbers, int64_t D, const int8_t* classes,
                               int64_t count, int32_t* mean, int32_t* scale);
// out [count]: values as inputs, (4 * 2^class value factor - offset) / 2^12, within +-2047; factor at least 1.
SE_EXPORT void se_code_inputs(const int32_t* values, const int8_t* classes, int64_t count, int32_t factor, int32_t offset, int16_t* out);
// out [C, count]: weighted means of columns [C, N] at parents [count, 4] with weights [count, 4] in 1/256.
SE_EXPORT void se_code_blend(const int16_t* columns, int64_t N, int64_t C, const int32_t* parents, const int32_t* weights, int64_t count,
                             int16_t* out);
// The two rows before and the two after each of rows [count] among coarse [coarse_count] (both ascending), and their weights by the distance
// of cells [N, 3].
SE_EXPORT void se_code_parents(const int32_t* cells, const int32_t* rows, int64_t count, const int32_t* coarse, int64_t coarse_count,
                               int32_t* parents, int32_t* weights);
// out [N, C]: whole numbers [C, N] times steps [C] times scale [N] (NULL: 1).
SE_EXPORT void se_code_restore(const int32_t* whole, int64_t N, int64_t C, const float* steps, const float* scale, float* out);

#endif
