// The error shim: MuJoCo reports an error by calling a handler that must not return. Here every call that can fail
// runs under setjmp; the handler jumps back over MuJoCo's own C frames, and over nothing else.
#ifndef MJSHIM_H_
#define MJSHIM_H_

#include <stdint.h>
#include <mujoco/mujoco.h>

#ifdef __cplusplus
extern "C" {
#endif

// Receives MuJoCo's warnings; called on the thread that caused them, and must return.
typedef void (*mjshim_warning_fn)(const char* message);

// Installs the error and warning handlers of the process. Call once, before any other function of MuJoCo.
void mjshim_install(mjshim_warning_fn warning);

// The message of the last error on this thread (valid until the next guarded call on it).
const char* mjshim_last_error(void);

// Parses and compiles a scene as mj_loadXML does; an error of any kind is NULL and a message in `error`.
mjModel* mjshim_load_xml(const char* filename, const mjVFS* vfs, char* error, int error_sz);

// Between the two files of the shim: whether this thread is inside mjshim_load_xml, and the way out of it.
int mjshim_is_loading(void);
void mjshim_throw(void);

// Guarded calls: 0 when done, 1 when MuJoCo raised an error, with the message in mjshim_last_error. After an error
// the mjData must be reset before it is used again.
int mjshim_step(const mjModel* m, mjData* d);
int mjshim_forward(const mjModel* m, mjData* d);
int mjshim_kinematics(const mjModel* m, mjData* d);
int mjshim_reset(const mjModel* m, mjData* d);
int mjshim_make_data(const mjModel* m, mjData** out);
int mjshim_copy_model(const mjModel* src, mjModel** out);
int mjshim_ray(const mjModel* m, const mjData* d, const mjtNum* pnt, const mjtNum* vec, const mjtByte* geomgroup,
               mjtByte flg_static, int bodyexclude, int* geomid, mjtNum* distance);

// Abstract scene: what is to be drawn. `mjshim_look` moves the camera, and the light that goes with it, of a scene that is
// up to date.
int mjshim_make_scene(const mjModel* m, mjvScene* scn, int maxgeom);
int mjshim_update_scene(const mjModel* m, mjData* d, const mjvOption* opt, mjvCamera* cam, mjvScene* scn);
int mjshim_look(const mjModel* m, mjData* d, mjvCamera* cam, mjvScene* scn);

// Drawing; an OpenGL context must be current. `rgb` and `depth` may be NULL.
int mjshim_make_context(const mjModel* m, mjrContext* con);
int mjshim_draw(mjrRect viewport, mjvScene* scn, mjrContext* con, unsigned char* rgb, float* depth);

// Raises an error on purpose: guarded != 0 under setjmp, otherwise as an unguarded call would.
int mjshim_raise(const char* message, int guarded);

// Field number `index` of the layout table: size or offset in bytes as this compiler has it; UINT64_MAX past the end.
uint64_t mjshim_layout(int index);

#ifdef __cplusplus
}
#endif

#endif  // MJSHIM_H_
