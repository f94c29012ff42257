#include "skin_points.h"

#include <algorithm>
#include <vector>

#include "pool.h"

namespace mien {
namespace {

constexpr int64_t kPiece = 1024;  // points in one piece of the pool's work
constexpr int kRow = 12;          // floats of an affine transform [3, 4]

void blend(const float* weights, const float* bones, int count, float* out) {
  std::fill_n(out, kRow, 0.0f);
  for (int k = 0; k < count; ++k) {
    for (int i = 0; i < kRow; ++i) out[i] += weights[k] * bones[kRow * k + i];
  }
}

void cross(const float* a, const float* b, float* out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

// The inverse of the left 3x3 part of an affine transform, by Cramer's rule.
void invert(const float* affine, float* inverse) {
  const float *a = affine, *b = affine + 4, *c = affine + 8;
  float columns[3][3];
  cross(b, c, columns[0]), cross(c, a, columns[1]), cross(a, b, columns[2]);
  const float scale = 1 / (a[0] * columns[0][0] + a[1] * columns[0][1] + a[2] * columns[0][2]);
  for (int r = 0; r < 3; ++r) {
    for (int column = 0; column < 3; ++column) inverse[3 * r + column] = columns[column][r] * scale;
  }
}

// Where a point is without skinning, and the inverse that brought it there.
struct AtRest {
  float place[3], inverse[9];
};

AtRest at_rest(const SkinPoints& task, int64_t index) {
  float affine[kRow];
  blend(task.weights + index * task.bones, task.from, task.bones, affine);
  AtRest rest;
  invert(affine, rest.inverse);
  const float* point = task.points + 3 * index;
  const float away[3] = {point[0] - affine[3], point[1] - affine[7], point[2] - affine[11]};
  for (int r = 0; r < 3; ++r) {
    const float* row = rest.inverse + 3 * r;
    rest.place[r] = row[0] * away[0] + row[1] * away[1] + row[2] * away[2];
  }
  return rest;
}

bool all_zero(const SkinPoints& task, const float* by_posed, int64_t index) {
  for (int64_t b = 0; b < task.poses; ++b) {
    const float* own = by_posed + 3 * (b * task.count + index);
    if (own[0] != 0 || own[1] != 0 || own[2] != 0) return false;
  }
  return true;
}

// One point in one pose. Adds to the gradients of its weights, of its place at rest, and of the bones.
void pose_backward(const SkinPoints& task, const SkinPointsGradients& gradients, int64_t index, int64_t b,
                   const AtRest& rest, float* by_rest, float* by_bones) {
  const int64_t at = 3 * (b * task.count + index);
  const float *weights = task.weights + index * task.bones, *g = gradients.posed + at;
  const float* bones = task.to + b * task.bones * kRow;
  float affine[kRow], by_affine[kRow];
  blend(weights, bones, task.bones, affine);
  for (int c = 0; c < 3; ++c) {
    const float by = affine[c] * g[0] + affine[4 + c] * g[1] + affine[8 + c] * g[2];
    gradients.moved[at + c] = by;
    by_rest[c] += by;
    const float shaped = rest.place[c] + task.moved[at + c];
    for (int r = 0; r < 3; ++r) by_affine[4 * r + c] = g[r] * shaped;
  }
  for (int r = 0; r < 3; ++r) by_affine[4 * r + 3] = g[r];
  float* by_weights = gradients.weights + index * task.bones;
  for (int k = 0; k < task.bones; ++k) {
    float total = 0;
    for (int i = 0; i < kRow; ++i) {
      total += by_affine[i] * bones[kRow * k + i];
      by_bones[(b * task.bones + k) * kRow + i] += weights[k] * by_affine[i];
    }
    by_weights[k] += total;
  }
}

void point_backward(const SkinPoints& task, const SkinPointsGradients& gradients, int64_t index, float* by_bones) {
  float* by_weights = gradients.weights + index * task.bones;
  float* by_point = gradients.points + 3 * index;
  std::fill_n(by_weights, task.bones, 0.0f);
  if (all_zero(task, gradients.posed, index)) {
    std::fill_n(by_point, 3, 0.0f);
    for (int64_t b = 0; b < task.poses; ++b) std::fill_n(gradients.moved + 3 * (b * task.count + index), 3, 0.0f);
    return;
  }
  const AtRest rest = at_rest(task, index);
  float by_rest[3] = {};
  for (int64_t b = 0; b < task.poses; ++b) pose_backward(task, gradients, index, b, rest, by_rest, by_bones);
  float by_affine[kRow];
  for (int c = 0; c < 3; ++c) {
    by_point[c] = rest.inverse[c] * by_rest[0] + rest.inverse[3 + c] * by_rest[1] + rest.inverse[6 + c] * by_rest[2];
  }
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) by_affine[4 * r + c] = -by_point[r] * rest.place[c];
    by_affine[4 * r + 3] = -by_point[r];
  }
  for (int k = 0; k < task.bones; ++k) {
    for (int i = 0; i < kRow; ++i) by_weights[k] += by_affine[i] * task.from[kRow * k + i];
  }
}

}  // namespace

void skin_points(const SkinPoints& task, float* posed) {
  parallel_for((task.count + kPiece - 1) / kPiece, [&](int64_t piece) {
    for (int64_t index = piece * kPiece; index < std::min((piece + 1) * kPiece, task.count); ++index) {
      const AtRest rest = at_rest(task, index);
      for (int64_t b = 0; b < task.poses; ++b) {
        float affine[kRow];
        blend(task.weights + index * task.bones, task.to + b * task.bones * kRow, task.bones, affine);
        const int64_t at = 3 * (b * task.count + index);
        float shaped[3];
        for (int c = 0; c < 3; ++c) shaped[c] = rest.place[c] + task.moved[at + c];
        for (int r = 0; r < 3; ++r) {
          const float* row = affine + 4 * r;
          posed[at + r] = row[0] * shaped[0] + row[1] * shaped[1] + row[2] * shaped[2] + row[3];
        }
      }
    }
  });
}

void skin_points_backward(const SkinPoints& task, const SkinPointsGradients& gradients) {
  const int64_t pieces = (task.count + kPiece - 1) / kPiece, size = task.poses * task.bones * kRow;
  std::vector<float> sums(pieces * size, 0.0f);
  parallel_for(pieces, [&](int64_t piece) {
    for (int64_t index = piece * kPiece; index < std::min((piece + 1) * kPiece, task.count); ++index) {
      point_backward(task, gradients, index, sums.data() + piece * size);
    }
  });
  std::fill_n(gradients.to, size, 0.0f);
  for (int64_t piece = 0; piece < pieces; ++piece) {  // in the order of the points
    for (int64_t i = 0; i < size; ++i) gradients.to[i] += sums[piece * size + i];
  }
}

}  // namespace mien
