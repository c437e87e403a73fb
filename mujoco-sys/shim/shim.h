// Error shim. MuJoCo reports an error by calling a handler that must not return. Every call that can fail runs
// under setjmp here, and the handler jumps back over MuJoCo's C frames only.
#ifndef MJSHIM_H_
#define MJSHIM_H_

#include <stddef.h>
#include <stdint.h>
#include <mujoco/mujoco.h>

#ifdef __cplusplus
extern "C" {
#endif

// Callback for MuJoCo's warnings. It runs on the thread that caused the warning, and must return.
typedef void (*mjshim_warning_fn)(const char* message);

// Stores the warning callback, and installs process-wide error and warning handlers unless a host program has
// installed its own. Call it once, before any other MuJoCo function.
void mjshim_install(mjshim_warning_fn warning);

// MuJoCo's thread-local handlers. They precede the process-wide ones; the shim sets its own only during its calls.
typedef void (*mjshim_handler_fn)(const char* message);
typedef struct {
  mjshim_handler_fn error;
  mjshim_handler_fn warning;
} mjshim_handlers;

// Exported by libmujoco, but not declared in its public headers.
mjshim_handler_fn _mjPRIVATE__get_tls_error_fn(void);
void _mjPRIVATE__set_tls_error_fn(mjshim_handler_fn handler);
mjshim_handler_fn _mjPRIVATE__get_tls_warning_fn(void);
void _mjPRIVATE__set_tls_warning_fn(mjshim_handler_fn handler);

// Internal to the shim: mjshim_enter sets this thread's handlers to the shim's and returns the previous ones,
// mjshim_leave restores them.
mjshim_handlers mjshim_enter(void);
void mjshim_leave(mjshim_handlers outer);

// Returns 1 if this thread has less than `needed` bytes of stack left, and sets mjshim_last_error; otherwise 0.
int mjshim_short_of_stack(size_t needed);

// Returns the message of the last error on this thread (valid until the thread's next guarded call).
const char* mjshim_last_error(void);

// Parses and compiles a scene as mj_loadXML does; on any error returns NULL and writes a message to `error`.
// Preserves the state of rand(), which MuJoCo seeds while it compiles, and this thread's handlers.
mjModel* mjshim_load_xml(const char* filename, const mjVFS* vfs, char* error, int error_sz);

// Internal to the shim: mjshim_is_loading returns 1 inside mjshim_load_xml, mjshim_throw leaves it with an
// exception.
int mjshim_is_loading(void);
void mjshim_throw(void);

// Return values of guarded calls. For the last two, mjshim_last_error has the message. After MJSHIM_RAISED the
// mjData must be reset before its next use. MJSHIM_NOT_STARTED means that the thread's stack is too small and that
// nothing has been done.
#define MJSHIM_DONE 0
#define MJSHIM_RAISED 1
#define MJSHIM_NOT_STARTED 2

int mjshim_step(const mjModel* m, mjData* d);
int mjshim_forward(const mjModel* m, mjData* d);
int mjshim_kinematics(const mjModel* m, mjData* d);
int mjshim_reset(const mjModel* m, mjData* d);
int mjshim_make_data(const mjModel* m, mjData** out);
int mjshim_copy_model(const mjModel* src, mjModel** out);
int mjshim_ray(const mjModel* m, const mjData* d, const mjtNum* pnt, const mjtNum* vec, const mjtByte* geomgroup,
               mjtByte flg_static, int bodyexclude, int* geomid, mjtNum* distance);

// Abstract scene. `mjshim_look` moves the camera, and the headlight with it, of an updated scene.
int mjshim_make_scene(const mjModel* m, mjvScene* scn, int maxgeom);
int mjshim_update_scene(const mjModel* m, mjData* d, const mjvOption* opt, mjvCamera* cam, mjvScene* scn);
int mjshim_look(const mjModel* m, mjData* d, mjvCamera* cam, mjvScene* scn);

// Rendering; an OpenGL context must be current. `rgb` and `depth` may be NULL.
int mjshim_make_context(const mjModel* m, mjrContext* con);
int mjshim_draw(mjrRect viewport, mjvScene* scn, mjrContext* con, unsigned char* rgb, float* depth);

// Mesa's software rasterizer starts LP_NUM_THREADS threads when a driver starts. The first function adds
// `LP_NUM_THREADS=0` to the environment unless the variable is set, the second removes it again. Only one thread at
// a time may call them; other threads may use the environment meanwhile.
void mjshim_without_rasteriser_threads(void);
void mjshim_restore_environment(void);

// Raises an error, for tests: under setjmp if guarded != 0, otherwise as an unguarded call does.
int mjshim_raise(const char* message, int guarded);

// Returns entry `index` of the layout table: size or offset in bytes as this compiler computes it; UINT64_MAX past
// the end.
uint64_t mjshim_layout(int index);

#ifdef __cplusplus
}
#endif

#endif  // MJSHIM_H_
