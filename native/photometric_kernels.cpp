// The photometric loss on a band of rows, streaming, four rows at a time: rows of the SSIM map are made once, their
// derivatives wait in a ring of rows until the window around a row is complete, then that row's gradient is written.
// Columns go by strips, so that what is filtered along columns is still in the L1 cache when it is filtered along rows.
#include "photometric_kernels.h"

#include "simd.h"

namespace {

using mien::PhotometricBand;

constexpr int RADIUS = mien::kPhotometricRadius;
constexpr int RING = mien::kPhotometricRing;
constexpr int ROWS = mien::kPhotometricRows;
constexpr int TAPS = ROWS + 2 * RADIUS;  // rows that ROWS windows see
constexpr int STRIP = 128, SIDES = 16;   // floats: the second at least the window's reach; whole vectors
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

MIEN_INLINE int smaller(int a, int b) { return a < b ? a : b; }
MIEN_INLINE int larger(int a, int b) { return a > b ? a : b; }

MIEN_INLINE void clear(float* from, const float* to) {
  for (; from < to; ++from) *from = 0;
}

// Filters `count` columns: vertical(from, to) strip by strip, and horizontal(from, to), which needs SIDES more on both
// sides, right behind it. All begin at whole vectors; the last ends at `count`.
template <typename Vertical, typename Horizontal>
MIEN_INLINE void sweep(int count, Vertical&& vertical, Horizontal&& horizontal) {
  int done = 0;
  for (int from = 0; from < count; from += STRIP) {
    const int to = smaller(from + STRIP, count), ready = to == count ? count : to - SIDES;
    vertical(from, to);
    horizontal(done, ready);
    done = ready;
  }
}

// Half of the window, from its edge to its middle: a copy that no store can be suspected to change.
struct Window {
  float w[RADIUS + 1];

  MIEN_INLINE explicit Window(const PhotometricBand& band) { memcpy(w, band.weights, sizeof w); }
};

// The window along columns for ROWS rows of one vector each, of the values that lie RADIUS rows above the first to
// RADIUS rows below the last. The same sums in the same order for every row.
MIEN_INLINE void filter_vertically(const F* values, const Window& window, float* const* rows, int x) {
  F sums[ROWS];
  for (int row = 0; row < ROWS; ++row) {
    const F* middle = values + row + RADIUS;
    sums[row] = middle[0] * window.w[RADIUS];
    for (int k = 1; k <= RADIUS; ++k) sums[row] = sums[row] + (middle[-k] + middle[k]) * window.w[RADIUS - k];
  }
  for (int row = 0; row < ROWS; ++row) store(rows[row] + x, sums[row]);
}

// Rows y - RADIUS .. of a picture, from column `origin`; rows beyond its border are all zero.
MIEN_INLINE void find_rows(const PhotometricBand& band, const float* picture, int y, const float** rows) {
  for (int k = 0; k < TAPS; ++k) {
    const int row = y - RADIUS + k;
    rows[k] = row < 0 || row >= band.height ? band.zeros : picture + row * band.stride + band.origin;
  }
}

// Image, target, image^2 + target^2 and image * target: both pictures stay in registers.
MIEN_INLINE void filter_pictures(const PhotometricBand& band, const float* const* images, const float* const* targets,
                                 const Window& window, int x) {
  F a[TAPS], b[TAPS];
  for (int k = 0; k < TAPS; ++k) a[k] = load(images[k] + x);
  filter_vertically(a, window, band.blurred[0], x);
  for (int k = 0; k < TAPS; ++k) b[k] = load(targets[k] + x);
  filter_vertically(b, window, band.blurred[1], x);
  for (int k = 0; k < TAPS; ++k) {
    // Rounded, or else some rows would get them so and others multiply and add at once.
    const F product = rounded(a[k] * b[k]);
    a[k] = rounded(a[k] * a[k] + b[k] * b[k]);
    b[k] = product;
  }
  filter_vertically(a, window, band.blurred[2], x);
  filter_vertically(b, window, band.blurred[3], x);
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

MIEN_INLINE F filter_horizontally(const float* row, const Window& window) {
  static_assert(RADIUS == 5, "the window is written out");
  F sum = load(row) * window.w[RADIUS];
  sum += pair_sum<1>(row) * window.w[RADIUS - 1];
  sum += pair_sum<2>(row) * window.w[RADIUS - 2];
  sum += pair_sum<3>(row) * window.w[RADIUS - 3];
  sum += pair_sum<4>(row) * window.w[RADIUS - 4];
  return sum + pair_sum<5>(row) * window.w[RADIUS - 5];
}

// One vector of a row of the SSIM map; its derivatives go into the ring.
MIEN_INLINE F map_vector(const PhotometricBand& band, const Window& window, int row, int slot, int x) {
  const F mean_x = filter_horizontally(band.blurred[0][row] + x, window);
  const F mean_y = filter_horizontally(band.blurred[1][row] + x, window);
  const F squares = filter_horizontally(band.blurred[2][row] + x, window);
  const F products = filter_horizontally(band.blurred[3][row] + x, window);
  const F mean_product = mean_x * mean_y, mean_squares = mean_x * mean_x + mean_y * mean_y;
  const F a1 = 2.0f * mean_product + C1, a2 = 2.0f * (products - mean_product) + C2;
  const F b1 = mean_squares + C1, b2 = squares - mean_squares + C2;
  const F inverse = reciprocal(b1 * b2);
  const F map = a1 * a2 * inverse;
  const F square_slope = -map * inverse * b1;
  store(band.ring[0][slot] + x, 2.0f * (mean_y * (a2 - a1) * inverse - mean_x * (map * inverse * b2 + square_slope)));
  store(band.ring[1][slot] + x, square_slope);
  store(band.ring[2][slot] + x, 2.0f * a1 * inverse);
  return map;
}

// ROWS rows of the SSIM map from row y on, as far as they lie inside the box: their sums, and their derivatives.
void map_rows(const PhotometricBand& band, int y) {
  const Window window(band);
  const float *images[TAPS], *targets[TAPS];
  find_rows(band, band.image, y, images);
  find_rows(band, band.target, y, targets);
  const int begin = band.left - band.origin, aligned = begin / W * W, end = band.right - band.origin;
  const int first = larger(band.top - y, 0), last = smaller(band.bottom - y, ROWS);
  const F left = set1((float)begin), right = set1((float)end);
  F sums[ROWS]{};
  const int count = band.limit - band.origin;
  sweep(
      count,
      [&](int from, int to) {
        // The last vector overlaps the one before it: no reads past the row.
        for (int x = from; x < to; x += W) filter_pictures(band, images, targets, window, smaller(x, count - W));
      },
      [&](int from, int to) {
        for (int row = first; row < last; ++row) {
          for (int x = larger(from, aligned); x < smaller(to, end); x += W) {
            const F map = map_vector(band, window, row, (y + row) & (RING - 1), x), column = iota() + (float)x;
            sums[row] = sums[row] + keep(both(less_equal(left, column), less(column, right)), map);
          }
        }
      });
  for (int row = first; row < last; ++row) {
    for (auto& map : band.ring) {  // what whole vectors wrote beside the box
      float* const own = map[(y + row) & (RING - 1)];
      clear(own + aligned, own + begin);
      clear(own + end, own + end + W);
    }
    if (y + row < band.begin || y + row >= band.end) continue;  // a neighbour's row
    double total = 0;
    for (int lane = 0; lane < W; ++lane) total += sums[row][lane];
    band.ssim_sums[y + row] = total;
  }
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

// One vector of a row of the gradient. The window is symmetric, so its adjoint is itself.
MIEN_INLINE F gradient_vector(const PhotometricBand& band, const Window& window, F a, F b, int row, int x) {
  const F by_mean = filter_horizontally(band.derivatives[0][row] + x, window);
  const F by_squares = filter_horizontally(band.derivatives[1][row] + x, window);
  const F by_products = filter_horizontally(band.derivatives[2][row] + x, window);
  return band.ssim_factor * (by_mean + 2.0f * a * by_squares + b * by_products);
}

// The gradient of ROWS rows of the grown box from row y on, as far as they belong to the band.
void gradient_rows(const PhotometricBand& band, int y) {
  const Window window(band);
  const int columns = band.limit - band.origin, last = smaller(band.end - y, ROWS);
  const F left = set1((float)(band.left - band.origin)), right = set1((float)(band.right - band.origin));
  const float* derivatives[3][TAPS];
  for (int k = 0; k < TAPS; ++k) {
    const int row = y - RADIUS + k;
    const bool inside = row >= band.top && row < band.bottom;
    for (int map = 0; map < 3; ++map) derivatives[map][k] = inside ? band.ring[map][row & (RING - 1)] : band.zeros;
  }
  sweep(
      columns,
      [&](int from, int to) {
        for (int x = from; x < to; x += W) {
          for (int map = 0; map < 3; ++map) {
            F values[TAPS];
            for (int k = 0; k < TAPS; ++k) values[k] = load(derivatives[map][k] + x);
            filter_vertically(values, window, band.derivatives[map], x);
          }
        }
      },
      [&](int from, int to) {
        for (int row = 0; row < last; ++row) {
          const int64_t at = (y + row) * band.stride + band.origin;
          const float *image = band.image + at, *target = band.target + at;
          const F l1_factor = set1(y + row >= band.top && y + row < band.bottom ? band.l1_factor : 0.0f);
          for (int block = from; block < to; block += W) {
            const int x = smaller(block, columns - W);
            const F a = load(image + x), b = load(target + x), column = iota() + (float)x;
            const F sign = keep(less(b, a), set1(1.0f)) - keep(less(a, b), set1(1.0f));
            const F l1 = keep(both(less_equal(left, column), less(column, right)), sign * l1_factor);
            store(band.gradient + at + x, l1 - gradient_vector(band, window, a, b, row, x));
          }
        }
      });
  for (int row = 0; row < last; ++row) {
    float* const own = band.gradient + (y + row) * band.stride;
    memset(own, 0, sizeof(float) * (size_t)band.origin);
    memset(own + band.limit, 0, sizeof(float) * (size_t)(band.stride - band.limit));
  }
}

}  // namespace

namespace mien::MIEN_ISA {
namespace {

void run_band(const PhotometricBand& band) {
  if (!band.gradient) {
    for (int y = band.begin; y < band.end; y += ROWS) map_rows(band, y);
  } else {
    // The gradient of a row needs the map RADIUS rows further.
    constexpr int kBehind = (ROWS - 1 + 2 * RADIUS) / ROWS * ROWS;
    for (int y = band.begin; y < band.end + kBehind; y += ROWS) {
      const int mapped = y - RADIUS;
      if (mapped + ROWS > band.top && mapped < band.bottom) map_rows(band, mapped);
      if (y - kBehind >= band.begin) gradient_rows(band, y - kBehind);
    }
  }
  for (int y = larger(band.begin, band.top); y < smaller(band.end, band.bottom); ++y) sum_l1(band, y);
}

void bytes_to_floats(const uint8_t* from, int64_t count, float* to) {
  for (int64_t i = 0; i < count; ++i) to[i] = (float)from[i] * (1.0f / 255);
}

}  // namespace

extern const PhotometricKernels photometric_kernels;
const PhotometricKernels photometric_kernels = {run_band, bytes_to_floats};

}  // namespace mien::MIEN_ISA
