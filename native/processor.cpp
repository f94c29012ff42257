#include "processor.h"

#if defined(__x86_64__)
#include <cpuid.h>

#include <cstdint>

namespace mien {
namespace {

struct Leaf {
  uint32_t eax = 0, ebx = 0, ecx = 0, edx = 0;
};

// What cpuid says; zeros for a leaf that this processor does not have.
Leaf leaf(uint32_t number) {
  Leaf own;
  if (!__get_cpuid_count(number, 0, &own.eax, &own.ebx, &own.ecx, &own.edx)) return {};
  return own;
}

constexpr uint32_t bit(int index) { return uint32_t{1} << index; }
constexpr bool all(uint32_t value, uint32_t bits) { return (value & bits) == bits; }

// Registers that the operating system saves when it switches threads. Without that, wide vectors lose their content.
uint32_t saved_registers() {
  constexpr uint32_t kOsxsave = bit(27);
  if (!all(leaf(1).ecx, kOsxsave)) return 0;
  uint32_t low, high;
  __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  return low;
}

}  // namespace

bool has_x86_64_v3() {
  constexpr uint32_t kSavedSse = bit(1), kSavedAvx = bit(2);
  constexpr uint32_t kFma = bit(12), kMovbe = bit(22), kPopcnt = bit(23), kAvx = bit(28), kF16c = bit(29);
  constexpr uint32_t kBmi1 = bit(3), kAvx2 = bit(5), kBmi2 = bit(8), kLzcnt = bit(5);
  return all(saved_registers(), kSavedSse | kSavedAvx) && all(leaf(1).ecx, kFma | kMovbe | kPopcnt | kAvx | kF16c) &&
         all(leaf(7).ebx, kBmi1 | kAvx2 | kBmi2) && all(leaf(0x80000001).ecx, kLzcnt);
}

bool has_x86_64_v4() {
  constexpr uint32_t kSavedMasks = bit(5), kSavedUpperHalves = bit(6), kSavedFurther = bit(7);
  constexpr uint32_t kF = bit(16), kDq = bit(17), kCd = bit(28), kBw = bit(30), kVl = bit(31);
  return has_x86_64_v3() && all(saved_registers(), kSavedMasks | kSavedUpperHalves | kSavedFurther) &&
         all(leaf(7).ebx, kF | kDq | kCd | kBw | kVl);
}

}  // namespace mien
#endif
