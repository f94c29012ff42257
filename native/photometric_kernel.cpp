// The photometric loss on a band of rows, streaming: each row of the SSIM map is made once, its derivatives wait in a
// ring of rows until the window around a row is complete, then that row's gradient is written. All in the L2 cache.
#include "photometric_band.h"
#include "simd.h"

namespace {

using mien::PhotometricBand;

constexpr int RADIUS = mien::kPhotometricRadius, TAPS = 2 * RADIUS + 1;
constexpr int RING = mien::kPhotometricRing;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

MIEN_INLINE int smaller(int a, int b) { return a < b ? a : b; }
MIEN_INLINE int larger(int a, int b) { return a > b ? a : b; }

MIEN_INLINE void clear(float* from, const float* to) {
  for (; from < to; ++from) *from = 0;
}

// Weighted sums along columns of the pictures (image, target, image^2 + target^2, image * target) for VECTORS
// vectors at a time, so that enough independent sums are in flight.
template <int VECTORS>
MIEN_INLINE void filter_block(const PhotometricBand& band, const float* weights, int64_t from, int taps, int x) {
  F mean_x[VECTORS]{}, mean_y[VECTORS]{}, squares[VECTORS]{}, products[VECTORS]{};
  const float *image = band.image + from + x, *target = band.target + from + x;
  for (int k = 0; k < taps; ++k, image += band.stride, target += band.stride) {
    for (int v = 0; v < VECTORS; ++v) {
      const F a = load(image + v * W), b = load(target + v * W);
      const F weighted_a = a * weights[k], weighted_b = b * weights[k];
      mean_x[v] += weighted_a;
      mean_y[v] += weighted_b;
      squares[v] += weighted_a * a + weighted_b * b;
      products[v] += weighted_a * b;
    }
  }
  for (int v = 0; v < VECTORS; ++v) {
    store(band.rows[0] + x + v * W, mean_x[v]);
    store(band.rows[1] + x + v * W, mean_y[v]);
    store(band.rows[2] + x + v * W, squares[v]);
    store(band.rows[3] + x + v * W, products[v]);
  }
}

void filter_pictures_vertically(const PhotometricBand& band, int y) {
  const int first = larger(y - RADIUS, 0), last = smaller(y + RADIUS, band.height - 1);
  const int count = band.limit - band.origin, taps = last - first + 1;
  const float* weights = band.weights + (first - y + RADIUS);
  const int64_t from = first * band.stride + band.origin;
  int x = 0;
  for (; x + 2 * W <= count; x += 2 * W) filter_block<2>(band, weights, from, taps, x);
  // The last vector overlaps the one before it: no reads past the row.
  for (; x < count; x += W) filter_block<1>(band, weights, from, taps, smaller(x, count - W));
}

// The floats that begin OFFSET before or after those at `row`, which is aligned with the vectors of its buffer. Loads
// that straddle two cache lines cost twice: with wide vectors nearly all would, so they are put together of aligned
// ones.
template <int OFFSET>
MIEN_INLINE F shifted(const float* row) {
#if defined(__AVX512F__)
  const int first = OFFSET < 0 ? -W : 0;
  const __m512i low = (__m512i)load(row + first), high = (__m512i)load(row + first + W);
  return (F)_mm512_alignr_epi32(high, low, OFFSET - first);
#else
  return load(row + OFFSET);
#endif
}

template <int K>
MIEN_INLINE F pair_sum(const float* row) {
  return shifted<-K * mien::kPhotometricChannels>(row) + shifted<K * mien::kPhotometricChannels>(row);
}

MIEN_INLINE F filter_horizontally(const float* row, const float* weights) {
  static_assert(RADIUS == 5, "the window is written out");
  F sum = load(row) * weights[RADIUS];
  sum += pair_sum<1>(row) * weights[RADIUS - 1];
  sum += pair_sum<2>(row) * weights[RADIUS - 2];
  sum += pair_sum<3>(row) * weights[RADIUS - 3];
  sum += pair_sum<4>(row) * weights[RADIUS - 4];
  return sum + pair_sum<5>(row) * weights[RADIUS - 5];
}

// One row of the SSIM map inside the box: its sum, and its derivatives into the ring.
void map_row(const PhotometricBand& band, int y) {
  filter_pictures_vertically(band, y);
  const int slot = y & (RING - 1);
  float *by_mean = band.ring[0][slot], *by_squares = band.ring[1][slot], *by_products = band.ring[2][slot];
  const int begin = band.left - band.origin, aligned = begin / W * W, end = band.right - band.origin;
  F map_sum{};
  for (int x = aligned; x < end; x += W) {
    const F mean_x = filter_horizontally(band.rows[0] + x, band.weights);
    const F mean_y = filter_horizontally(band.rows[1] + x, band.weights);
    const F squares = filter_horizontally(band.rows[2] + x, band.weights);
    const F products = filter_horizontally(band.rows[3] + x, band.weights);
    const F mean_product = mean_x * mean_y, mean_squares = mean_x * mean_x + mean_y * mean_y;
    const F a1 = 2.0f * mean_product + C1, a2 = 2.0f * (products - mean_product) + C2;
    const F b1 = mean_squares + C1, b2 = squares - mean_squares + C2;
    const F inverse = 1.0f / (b1 * b2);
    const F map = a1 * a2 * inverse;
    const F square_slope = -map * inverse * b1;
    store(by_mean + x, 2.0f * (mean_y * (a2 - a1) * inverse - mean_x * (map * inverse * b2 + square_slope)));
    store(by_squares + x, square_slope);
    store(by_products + x, 2.0f * a1 * inverse);
    map_sum += keep(both(less_equal(set1((float)(begin - x)), iota()), less(iota(), set1((float)(end - x)))), map);
  }
  // What whole vectors wrote beside the box.
  clear(by_mean + aligned, by_mean + begin);
  clear(by_squares + aligned, by_squares + begin);
  clear(by_products + aligned, by_products + begin);
  clear(by_mean + end, by_mean + end + 2 * W);
  clear(by_squares + end, by_squares + end + 2 * W);
  clear(by_products + end, by_products + end + 2 * W);
  if (y < band.begin || y >= band.end) return;  // a neighbour's row
  double total = 0;
  for (int lane = 0; lane < W; ++lane) total += map_sum[lane];
  band.ssim_sums[y] = total;
}

void sum_l1(const PhotometricBand& band, int y) {
  const float* image = band.image + y * band.stride;
  const float* target = band.target + y * band.stride;
  F sums{};
  int x = band.left;
  for (; x + W <= band.right; x += W) {
    const F difference = load(image + x) - load(target + x);
    sums += maximum(difference, -difference);
  }
  double total = 0;
  for (; x < band.right; ++x) total += __builtin_fabsf(image[x] - target[x]);
  for (int lane = 0; lane < W; ++lane) total += sums[lane];
  band.l1_sums[y] = total;
}

// Weighted sums along columns of the three rings of derivatives; whole vectors may reach past the box, where the rings
// hold zeros.
void filter_derivatives_vertically(const PhotometricBand& band, int y) {
  const int first = larger(y - RADIUS, band.top), last = smaller(y + RADIUS, band.bottom - 1);
  const int begin = (band.left - band.origin) / W * W, end = band.right - band.origin;
  const float* weights = band.weights + (first - y + RADIUS);
  const float* taps[TAPS][3];
  for (int k = 0; k <= last - first; ++k)
    for (int map = 0; map < 3; ++map) taps[k][map] = band.ring[map][(first + k) & (RING - 1)];
  for (int x = begin; x < end; x += 2 * W) {
    F sums[3][2]{};
    for (int k = 0; k <= last - first; ++k) {
      for (int map = 0; map < 3; ++map) {
        sums[map][0] += load(taps[k][map] + x) * weights[k];
        sums[map][1] += load(taps[k][map] + x + W) * weights[k];
      }
    }
    for (int map = 0; map < 3; ++map) {
      store(band.rows[map] + x, sums[map][0]);
      store(band.rows[map] + x + W, sums[map][1]);
    }
  }
  for (int map = 0; map < 3; ++map) {
    // What the pictures' filter left outside the box.
    float* row = band.rows[map];
    clear(row, row + begin);
    clear(row + end, row + larger(end + 2 * W, band.limit - band.origin));
  }
}

// The gradient of one row of the grown box. The window is symmetric, so its adjoint is itself.
void gradient_row(const PhotometricBand& band, int y) {
  filter_derivatives_vertically(band, y);
  const float* image = band.image + y * band.stride + band.origin;
  const float* target = band.target + y * band.stride + band.origin;
  float* gradient = band.gradient + y * band.stride + band.origin;
  const int columns = band.limit - band.origin;
  const F l1_factor = set1(y >= band.top && y < band.bottom ? band.l1_factor : 0.0f);
  const F left = set1((float)(band.left - band.origin)), right = set1((float)(band.right - band.origin));
  for (int block = 0; block < columns; block += W) {
    const int x = smaller(block, columns - W);
    const F a = load(image + x), b = load(target + x), column = iota() + (float)x;
    const F by_mean = filter_horizontally(band.rows[0] + x, band.weights);
    const F by_squares = filter_horizontally(band.rows[1] + x, band.weights);
    const F by_products = filter_horizontally(band.rows[2] + x, band.weights);
    const F sign = keep(less(b, a), set1(1.0f)) - keep(less(a, b), set1(1.0f));
    const F l1 = keep(both(less_equal(left, column), less(column, right)), sign * l1_factor);
    store(gradient + x, l1 - band.ssim_factor * (by_mean + 2.0f * a * by_squares + b * by_products));
  }
  memset(gradient - band.origin, 0, sizeof(float) * (size_t)band.origin);
  memset(gradient + columns, 0, sizeof(float) * (size_t)(band.stride - band.limit));
}

}  // namespace

namespace mien::MIEN_ISA {
namespace {

void run_band(const PhotometricBand& band) {
  const int halo = band.gradient ? RADIUS : 0;
  for (int row = band.begin - halo; row < band.end + halo; ++row) {
    if (row >= band.top && row < band.bottom) {
      map_row(band, row);
      if (row >= band.begin && row < band.end) sum_l1(band, row);
    }
    const int finished = row - halo;
    if (band.gradient && finished >= band.begin && finished < band.end) gradient_row(band, finished);
  }
}

void bytes_to_floats(const uint8_t* from, int64_t count, float* to) {
  for (int64_t i = 0; i < count; ++i) to[i] = (float)from[i] * (1.0f / 255);
}

}  // namespace

extern const PhotometricKernels photometric_kernels;
const PhotometricKernels photometric_kernels = {run_band, bytes_to_floats};

}  // namespace mien::MIEN_ISA
