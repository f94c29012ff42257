// A picture over one colour, blended by a mask of bytes: the target of a training step.
#pragma once

#include <cstdint>

#include "training.h"

namespace mien {

struct CompositeTask {
  const uint8_t* image;  // [h,w,3]
  const uint8_t* matte;  // [h,w], 255 is opaque
  int width, height;
  uint8_t background[3];
  PixelBox box;      // inside the picture; all of the matte that is not zero lies within it
  uint8_t* picture;  // [h,w,3], written; outside the box it is the background
};

// round((image * matte + background * (255 - matte)) / 255), exactly. Runs on the caller's thread alone: the pool is
// for the training step that runs meanwhile.
void composite(const CompositeTask& task);

}  // namespace mien
