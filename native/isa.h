// Kernels that are compiled once per instruction set: how an operation declares them and finds the one to call.
#pragma once

#include <string>

#include "rasterize.h"

// In namespace mien: declares `Type name` of each instruction set, and `name()` for the one the rasterizer runs on.
#if defined(__x86_64__) && !defined(MIEN_PORTABLE)  // MIEN_PORTABLE: sanitizers check what runs elsewhere
#define MIEN_CHOOSE_KERNELS(Type, name)                                              \
  namespace avx512 {                                                                 \
  extern const Type name;                                                            \
  }                                                                                  \
  namespace avx2 {                                                                   \
  extern const Type name;                                                            \
  }                                                                                  \
  namespace sse4 {                                                                   \
  extern const Type name;                                                            \
  }                                                                                  \
  static const Type& name() {                                                        \
    const std::string isa = rasterize_isa();                                         \
    return isa == "avx512" ? avx512::name : isa == "avx2" ? avx2::name : sse4::name; \
  }
#else
#define MIEN_CHOOSE_KERNELS(Type, name) \
  namespace baseline {                  \
  extern const Type name;               \
  }                                     \
  static const Type& name() { return baseline::name; }
#endif
