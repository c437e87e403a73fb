#define _GNU_SOURCE  // pthread_getattr_np

#include "shim.h"

#include <pthread.h>
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// innermost guarded call of this thread, NULL outside of guarded calls
static _Thread_local jmp_buf* guard = NULL;
static _Thread_local char last_error[1000] = "";

static void on_error(const char* message) {
  snprintf(last_error, sizeof(last_error), "%s", message ? message : "unknown error");

  // inside a guarded call, jump back to it: only MuJoCo's C frames lie between
  if (guard) {
    longjmp(*guard, 1);
  }

  // inside the parser, throw
  if (mjshim_is_loading()) {
    mjshim_throw();
  }

  // elsewhere, Rust or C++ frames may lie between, which a jump must not skip
  fprintf(stderr, "mujoco: fatal error: %s\n", last_error);
  fflush(stderr);
  abort();
}

static mjshim_warning_fn warning_callback = NULL;

// the callback is foreign code: an error raised in it must not jump over its frames
static void on_warning(const char* message) {
  jmp_buf* const outer = guard;
  guard = NULL;
  if (warning_callback) {
    warning_callback(message);
  }
  guard = outer;
}

void mjshim_install(mjshim_warning_fn warning) {
  warning_callback = warning;
  // the process-wide handlers serve unguarded calls; handlers of a host program stay
  if (!mju_user_error) {
    mju_user_error = on_error;
  }
  if (!mju_user_warning) {
    mju_user_warning = on_warning;
  }
}

mjshim_handlers mjshim_enter(void) {
  const mjshim_handlers outer = {_mjPRIVATE__get_tls_error_fn(), _mjPRIVATE__get_tls_warning_fn()};
  _mjPRIVATE__set_tls_error_fn(on_error);
  _mjPRIVATE__set_tls_warning_fn(on_warning);
  return outer;
}

void mjshim_leave(mjshim_handlers outer) {
  _mjPRIVATE__set_tls_error_fn(outer.error);
  _mjPRIVATE__set_tls_warning_fn(outer.warning);
}

// Lowest and highest address of this thread's stack; both 0 before the first query.
static _Thread_local uintptr_t stack_low = 0;
static _Thread_local uintptr_t stack_high = 0;

static void find_stack(void) {
  pthread_attr_t attributes;
  void* low = NULL;
  size_t size = 0;
  stack_low = stack_high = UINTPTR_MAX;  // unknown
  if (pthread_getattr_np(pthread_self(), &attributes)) {
    return;
  }
  if (!pthread_attr_getstack(&attributes, &low, &size) && low) {
    stack_low = (uintptr_t)low;
    stack_high = stack_low + size;
  }
  pthread_attr_destroy(&attributes);
}

int mjshim_short_of_stack(size_t needed) {
  const uintptr_t here = (uintptr_t)__builtin_frame_address(0);
  if (!stack_high) {
    find_stack();
  }
  // accept a stack that the thread library does not know (a coroutine's)
  if (here < stack_low || here >= stack_high || here - stack_low >= needed) {
    return 0;
  }
  snprintf(last_error, sizeof(last_error), "the thread has %zu KiB of stack left, expected at least %zu KiB",
           (size_t)(here - stack_low) / 1024, needed / 1024);
  return 1;
}

const char* mjshim_last_error(void) {
  return last_error;
}

// Stack required for a call, bytes. Measured: 44 KiB for the deepest step, with all geom types in contact.
#define SIMULATION_STACK (128 * 1024)

// runs CALL under its own guard and returns MJSHIM_DONE, or the reason why CALL did not complete
#define GUARDED(CALL)                                 \
  if (mjshim_short_of_stack(SIMULATION_STACK)) {      \
    return MJSHIM_NOT_STARTED;                        \
  }                                                   \
  jmp_buf here;                                       \
  jmp_buf* const outer = guard;                       \
  const mjshim_handlers handlers = mjshim_enter();    \
  if (setjmp(here)) {                                 \
    guard = outer;                                    \
    mjshim_leave(handlers);                           \
    return MJSHIM_RAISED;                             \
  }                                                   \
  guard = &here;                                      \
  CALL;                                               \
  guard = outer;                                      \
  mjshim_leave(handlers);                             \
  return MJSHIM_DONE;

int mjshim_step(const mjModel* m, mjData* d) {
  GUARDED(mj_step(m, d))
}

int mjshim_forward(const mjModel* m, mjData* d) {
  GUARDED(mj_forward(m, d))
}

// computes positions, cameras and lights only, which is all that rendering needs
static void kinematics(const mjModel* m, mjData* d) {
  mj_kinematics(m, d);
  mj_comPos(m, d);
  mj_camlight(m, d);
}

int mjshim_kinematics(const mjModel* m, mjData* d) {
  GUARDED(kinematics(m, d))
}

int mjshim_reset(const mjModel* m, mjData* d) {
  GUARDED(mj_resetData(m, d))
}

int mjshim_make_data(const mjModel* m, mjData** out) {
  GUARDED(*out = mj_makeData(m))
}

int mjshim_copy_model(const mjModel* src, mjModel** out) {
  GUARDED(*out = mj_copyModel(NULL, src))
}

int mjshim_ray(const mjModel* m, const mjData* d, const mjtNum* pnt, const mjtNum* vec, const mjtByte* geomgroup,
               mjtByte flg_static, int bodyexclude, int* geomid, mjtNum* distance) {
  GUARDED(*distance = mj_ray(m, d, pnt, vec, geomgroup, flg_static, bodyexclude, geomid))
}

int mjshim_make_scene(const mjModel* m, mjvScene* scn, int maxgeom) {
  GUARDED(mjv_makeScene(m, scn, maxgeom))
}

int mjshim_update_scene(const mjModel* m, mjData* d, const mjvOption* opt, mjvCamera* cam, mjvScene* scn) {
  GUARDED(mjv_updateScene(m, d, opt, NULL, cam, mjCAT_ALL, scn))
}

static void look(const mjModel* m, mjData* d, mjvCamera* cam, mjvScene* scn) {
  mjv_updateCamera(m, d, cam, scn);
  mjv_makeLights(m, d, scn);
}

int mjshim_look(const mjModel* m, mjData* d, mjvCamera* cam, mjvScene* scn) {
  GUARDED(look(m, d, cam, scn))
}

static void make_context(const mjModel* m, mjrContext* con) {
  mjr_makeContext(m, con, mjFONTSCALE_50);
  mjr_setBuffer(mjFB_OFFSCREEN, con);
}

int mjshim_make_context(const mjModel* m, mjrContext* con) {
  GUARDED(make_context(m, con))
}

static void draw(mjrRect viewport, mjvScene* scn, mjrContext* con, unsigned char* rgb, float* depth) {
  mjr_render(viewport, scn, con);
  mjr_readPixels(rgb, depth, viewport, con);
}

int mjshim_draw(mjrRect viewport, mjvScene* scn, mjrContext* con, unsigned char* rgb, float* depth) {
  GUARDED(draw(viewport, scn, con, rgb, depth))
}

static int raise_guarded(const char* message) {
  GUARDED(mju_error(message))
}

int mjshim_raise(const char* message, int guarded) {
  if (guarded) {
    return raise_guarded(message);
  }
  mju_error(message);
  return 0;
}

uint64_t mjshim_layout(int index) {
  static const uint64_t table[] = {
#include "layout.inc"
  };
  const int count = (int)(sizeof(table) / sizeof(table[0]));
  return index >= 0 && index < count ? table[index] : UINT64_MAX;
}
