// Stores into the pages of a mapped file that another program may truncate. The system answers a store beyond the
// end of a mapped file with SIGBUS. Inside `append_file_store` the handler turns the signal into a return value;
// other SIGBUS signals go to the previous handler.
#define _GNU_SOURCE  // siginfo_t, sigsetjmp

#include <setjmp.h>
#include <signal.h>
#include <stdatomic.h>
#include <stddef.h>
#include <string.h>

// active store of this thread, NULL outside of a store
static _Thread_local sigjmp_buf* volatile storing = NULL;
static _Thread_local const char* volatile first_byte = NULL;
static _Thread_local const char* volatile last_byte = NULL;

static struct sigaction previous;

static void on_bus_error(int signal, siginfo_t* info, void* context) {
  const char* const address = info->si_addr;
  // the jump crosses only memcpy and `append_file_store`
  if (storing && info->si_code > 0 && address >= first_byte && address <= last_byte) {
    siglongjmp(*storing, 1);
  }
  if (previous.sa_flags & SA_SIGINFO) {
    previous.sa_sigaction(signal, info, context);
  } else if (previous.sa_handler != SIG_DFL && previous.sa_handler != SIG_IGN) {
    previous.sa_handler(signal);
  } else if (previous.sa_handler == SIG_DFL || info->si_code > 0) {
    // default action: at once for a signal that was sent; at the next attempt for a fault, which cannot be ignored
    struct sigaction standard = {.sa_handler = SIG_DFL};
    sigemptyset(&standard.sa_mask);
    sigaction(SIGBUS, &standard, NULL);
    if (info->si_code <= 0) {
      raise(SIGBUS);
    }
  }
}

int append_file_catch_bus_errors(void) {
  struct sigaction action = {.sa_sigaction = on_bus_error, .sa_flags = SA_SIGINFO | SA_ONSTACK | SA_NODEFER};
  sigemptyset(&action.sa_mask);
  // the handler may run before `sigaction` returns, so that `previous` must be set first
  return sigaction(SIGBUS, NULL, &previous) || sigaction(SIGBUS, &action, NULL);
}

int append_file_store(char* target, const char* line, size_t length) {
  if (!length) {
    return 0;
  }
  sigjmp_buf here;
  if (sigsetjmp(here, 0)) {
    storing = NULL;
    return 1;
  }
  first_byte = target;
  last_byte = target + length - 1;
  storing = &here;
  atomic_signal_fence(memory_order_seq_cst);
  memcpy(target + 1, line + 1, length - 1);
  __atomic_store_n(target, line[0], __ATOMIC_RELEASE);
  atomic_signal_fence(memory_order_seq_cst);
  storing = NULL;
  return 0;
}
