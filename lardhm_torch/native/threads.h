// Threads of torch's pool. A forked child of a process that used the pool runs on one thread: the pool
// would hang.

#pragma once

#include <cstdint>

namespace lardhm {

int64_t num_threads();

// work(context, task) for task = 0 .. tasks - 1, each once, on up to num_threads() threads.
void run_tasks(int64_t tasks, void (*work)(const void*, int64_t), const void* context);

// The same of work(task).
template <class Work>
void run_tasks(int64_t tasks, const Work& work) {
  const auto call = [](const void* context, int64_t task) {
    (*static_cast<const Work*>(context))(task);
  };
  run_tasks(tasks, call, &work);
}

}  // namespace lardhm
