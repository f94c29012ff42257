// Which instruction sets this processor and its operating system have, asked of the processor itself: what compilers
// offer for that (__builtin_cpu_supports) needs their own runtime, and answers "none" where zig or clang-cl links.
#pragma once

namespace mien {

#if defined(__x86_64__)
// The levels of the x86-64 psABI: v3 is AVX2 and what came with it, v4 is AVX-512 F, BW, CD, DQ and VL.
bool has_x86_64_v3();
bool has_x86_64_v4();
#endif

}  // namespace mien
