#define _POSIX_C_SOURCE 200809L  // setenv

#include "shim.h"

#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// innermost guarded call of this thread, NULL outside of one
static _Thread_local jmp_buf* guard = NULL;
static _Thread_local char last_error[1000] = "";

static void on_error(const char* message) {
  snprintf(last_error, sizeof(last_error), "%s", message ? message : "unknown error");

  // inside a guarded call: back to it; only MuJoCo's C frames lie between
  if (guard) {
    longjmp(*guard, 1);
  }

  // inside the parser: its own way out
  if (mjshim_is_loading()) {
    mjshim_throw();
  }

  // elsewhere there may be Rust or C++ frames in between, which must not be jumped over
  fprintf(stderr, "mujoco: fatal error: %s\n", last_error);
  fflush(stderr);
  abort();
}

// Mesa's software rasteriser starts threads of its own unless it is told not to. At the size of observations waking
// them costs more than they draw, and whoever draws on several threads has a context for each. It reads this when a
// driver starts; it is set here, before main and before there is any other thread, because setting it later could
// race with whatever C code reads the environment. What the user has set stands.
__attribute__((constructor)) static void without_rasteriser_threads(void) {
  setenv("LP_NUM_THREADS", "0", 0);
}

static mjshim_warning_fn warning_callback = NULL;

// the callback is not MuJoCo's code: an error raised in it must not jump over its frames
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
  mju_user_error = on_error;
  mju_user_warning = on_warning;
}

const char* mjshim_last_error(void) {
  return last_error;
}

// runs CALL under a guard of its own and returns whether it raised an error
#define GUARDED(CALL)                    \
  jmp_buf here;                          \
  jmp_buf* const outer = guard;          \
  if (setjmp(here)) {                    \
    guard = outer;                       \
    return 1;                            \
  }                                      \
  guard = &here;                         \
  CALL;                                  \
  guard = outer;                         \
  return 0;

int mjshim_step(const mjModel* m, mjData* d) {
  GUARDED(mj_step(m, d))
}

int mjshim_forward(const mjModel* m, mjData* d) {
  GUARDED(mj_forward(m, d))
}

// positions, cameras and lights only: what drawing needs
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
