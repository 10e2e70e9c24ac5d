// Threads: torch's pool; a forked child of a process that used it works alone (it would hang).

#pragma once

#include <torch/csrc/stable/ops.h>

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <cstdint>

namespace lardhm {

inline std::atomic<bool> forked{false};

inline void note_fork() { forked = true; }

inline const int fork_handler = pthread_atfork(nullptr, nullptr, note_fork);

inline int64_t num_threads() {
  return forked ? 1 : std::max<int64_t>(1, torch::stable::get_num_threads());
}

// work(task) for task = 0 .. tasks - 1, each once, on up to num_threads() threads.
template <class Work>
void run_tasks(int64_t tasks, const Work& work) {
  const int64_t workers = std::min(tasks, num_threads());
  if (workers <= 1) {
    for (int64_t task = 0; task < tasks; ++task) work(task);
    return;
  }
  std::atomic<int64_t> next{0};
  torch::stable::parallel_for(0, workers, 1, [&](int64_t begin, int64_t end) {
    for (int64_t worker = begin; worker < end; ++worker)
      for (int64_t task = next++; task < tasks; task = next++) work(task);
  });
}

}  // namespace lardhm
