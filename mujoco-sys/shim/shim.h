// The error shim: MuJoCo reports an error by calling a handler that must not return. Here every call that can fail
// runs under setjmp; the handler jumps back over MuJoCo's own C frames, and over nothing else.
#ifndef MJSHIM_H_
#define MJSHIM_H_

#include <stddef.h>
#include <stdint.h>
#include <mujoco/mujoco.h>

#ifdef __cplusplus
extern "C" {
#endif

// Receives MuJoCo's warnings; called on the thread that caused them, and must return.
typedef void (*mjshim_warning_fn)(const char* message);

// Keeps the receiver of warnings, and installs error and warning handlers of the process where a host program has not
// installed its own. Call once, before any other function of MuJoCo.
void mjshim_install(mjshim_warning_fn warning);

// MuJoCo's handlers of this thread. They go before those of the process; the shim's own are there only inside its calls.
typedef void (*mjshim_handler_fn)(const char* message);
typedef struct {
  mjshim_handler_fn error;
  mjshim_handler_fn warning;
} mjshim_handlers;

// Exported by libmujoco, declared in none of its public headers.
mjshim_handler_fn _mjPRIVATE__get_tls_error_fn(void);
void _mjPRIVATE__set_tls_error_fn(mjshim_handler_fn handler);
mjshim_handler_fn _mjPRIVATE__get_tls_warning_fn(void);
void _mjPRIVATE__set_tls_warning_fn(mjshim_handler_fn handler);

// Between the two files of the shim: sets this thread's handlers to the shim's and returns those that were there, and puts
// these back.
mjshim_handlers mjshim_enter(void);
void mjshim_leave(mjshim_handlers outer);

// Whether this thread has less than `needed` bytes of stack left; the message is then in mjshim_last_error.
int mjshim_short_of_stack(size_t needed);

// The message of the last error on this thread (valid until the next guarded call on it).
const char* mjshim_last_error(void);

// Parses and compiles a scene as mj_loadXML does; an error of any kind is NULL and a message in `error`. The state of
// rand(), which MuJoCo seeds while it compiles, and this thread's handlers are afterwards what they were before.
mjModel* mjshim_load_xml(const char* filename, const mjVFS* vfs, char* error, int error_sz);

// Between the two files of the shim: whether this thread is inside mjshim_load_xml, and the way out of it.
int mjshim_is_loading(void);
void mjshim_throw(void);

// What guarded calls return. With the last two the message is in mjshim_last_error. After MJSHIM_RAISED the mjData must
// be reset before it is used again; after MJSHIM_NOT_STARTED, which says that the thread's stack is too small, nothing
// has been done.
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

// Abstract scene: what is to be drawn. `mjshim_look` moves the camera, and the light that goes with it, of a scene that is
// up to date.
int mjshim_make_scene(const mjModel* m, mjvScene* scn, int maxgeom);
int mjshim_update_scene(const mjModel* m, mjData* d, const mjvOption* opt, mjvCamera* cam, mjvScene* scn);
int mjshim_look(const mjModel* m, mjData* d, mjvCamera* cam, mjvScene* scn);

// Drawing; an OpenGL context must be current. `rgb` and `depth` may be NULL.
int mjshim_make_context(const mjModel* m, mjrContext* con);
int mjshim_draw(mjrRect viewport, mjvScene* scn, mjrContext* con, unsigned char* rgb, float* depth);

// Mesa's software rasteriser starts threads of its own, as many as LP_NUM_THREADS says, when a driver starts. The first function
// adds `LP_NUM_THREADS=0` to the environment unless the variable is there, the second takes it out again. Not for two threads
// at once; other threads may use the environment meanwhile.
void mjshim_without_rasteriser_threads(void);
void mjshim_restore_environment(void);

// Raises an error on purpose: guarded != 0 under setjmp, otherwise as an unguarded call would.
int mjshim_raise(const char* message, int guarded);

// Field number `index` of the layout table: size or offset in bytes as this compiler has it; UINT64_MAX past the end.
uint64_t mjshim_layout(int index);

#ifdef __cplusplus
}
#endif

#endif  // MJSHIM_H_
