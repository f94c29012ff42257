// Memory for large results that comes back: the kernel clears fresh pages, which takes longer than drawing on them.
#pragma once

#include <cstddef>

namespace mien {

// At least `bytes`, aligned to a cache line; what it holds is undefined. Null where there is no memory.
void* take_memory(size_t bytes);
// Keeps it for the next `take_memory` of the same size, or frees it. `bytes` are those it was taken with.
void give_memory(void* memory, size_t bytes);

}  // namespace mien
