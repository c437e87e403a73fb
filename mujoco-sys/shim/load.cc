// MuJoCo's parser and compiler are C++. What they throw, and what the engine beneath them raises, becomes a message
// here: an exception runs their destructors and releases their lock, where a jump would skip both.
#include "shim.h"

#include <exception>
#include <cstdio>

namespace {

struct Raised {};

thread_local bool loading = false;

void Say(char* error, int error_sz, const char* message) {
  if (error && error_sz > 0) {
    std::snprintf(error, static_cast<size_t>(error_sz), "%s", message);
  }
}

}  // namespace

extern "C" int mjshim_is_loading(void) {
  return loading;
}

extern "C" void mjshim_throw(void) {
  throw Raised();
}

extern "C" mjModel* mjshim_load_xml(const char* filename, const mjVFS* vfs, char* error, int error_sz) {
  mjModel* model = nullptr;
  loading = true;
  try {
    model = mj_loadXML(filename, vfs, error, error_sz);
  } catch (const Raised&) {
    Say(error, error_sz, mjshim_last_error());
  } catch (const std::exception& exception) {
    Say(error, error_sz, exception.what());
  } catch (...) {
    Say(error, error_sz, "unknown exception");
  }
  loading = false;
  return model;
}
