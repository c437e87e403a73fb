// Loads models. MuJoCo's parser and compiler are C++, so that errors leave them as exceptions: these run
// destructors and release MuJoCo's lock, which a longjmp would skip.
#include "shim.h"

#include <cstdio>
#include <cstdlib>
#include <exception>
#include <mutex>

namespace {

struct Raised {};

thread_local bool loading = false;

void Say(char* error, int error_sz, const char* message) {
  if (error && error_sz > 0) {
    std::snprintf(error, static_cast<size_t>(error_sz), "%s", message);
  }
}

// Stack required for loading, bytes. Measured: 205 KiB for a scene of 95 nested bodies, the parser's limit.
constexpr size_t kLoadStack = 512 * 1024;

// MuJoCo seeds rand() to make its textures reproducible. This class gives it a separate generator state, so that
// the host program's sequence continues unchanged. The state belongs to the process, so that one thread at a time
// loads (MuJoCo takes its own lock later).
class OwnRandomState {
 public:
  OwnRandomState() : lock_(Mutex()) {
    static char state[128];
    host_ = initstate(1, state, sizeof(state));
  }

  ~OwnRandomState() {
    if (host_) {
      setstate(host_);
    }
  }

 private:
  static std::mutex& Mutex() {
    static std::mutex mutex;
    return mutex;
  }

  std::lock_guard<std::mutex> lock_;
  char* host_;
};

// MuJoCo's compiler installs its own handlers and restores the previous ones, but not if an unknown exception
// passes through it.
class Handlers {
 public:
  Handlers() : outer_(mjshim_enter()) { loading = true; }

  ~Handlers() {
    loading = false;
    mjshim_leave(outer_);
  }

 private:
  const mjshim_handlers outer_;
};

}  // namespace

extern "C" int mjshim_is_loading(void) {
  return loading;
}

extern "C" void mjshim_throw(void) {
  throw Raised();
}

extern "C" mjModel* mjshim_load_xml(const char* filename, const mjVFS* vfs, char* error, int error_sz) {
  if (mjshim_short_of_stack(kLoadStack)) {
    Say(error, error_sz, mjshim_last_error());
    return nullptr;
  }
  const OwnRandomState random;
  const Handlers handlers;
  mjModel* model = nullptr;
  try {
    model = mj_loadXML(filename, vfs, error, error_sz);
  } catch (const Raised&) {
    Say(error, error_sz, mjshim_last_error());
  } catch (const std::exception& exception) {
    Say(error, error_sz, exception.what());
  } catch (...) {
    Say(error, error_sz, "unknown exception");
  }
  return model;
}
