// Work shared out to the threads of torch.

#include "threads.h"

#include <pthread.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <atomic>

namespace lardhm {
namespace {

std::atomic<bool> forked{false};

void note_fork() { forked = true; }

const int fork_handler = pthread_atfork(nullptr, nullptr, note_fork);

}  // namespace

int64_t num_threads() {
  return forked ? 1 : std::max<int64_t>(1, torch::stable::get_num_threads());
}

void run_tasks(int64_t tasks, void (*work)(const void*, int64_t), const void* context) {
  const int64_t workers = std::min(tasks, num_threads());
  if (workers <= 1) {
    for (int64_t task = 0; task < tasks; ++task) work(context, task);
    return;
  }
  std::atomic<int64_t> next{0};
  torch::stable::parallel_for(0, workers, 1, [&](int64_t begin, int64_t end) {
    for (int64_t worker = begin; worker < end; ++worker)
      for (int64_t task = next++; task < tasks; task = next++) work(context, task);
  });
}

}  // namespace lardhm
