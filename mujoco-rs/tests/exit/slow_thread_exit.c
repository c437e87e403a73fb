// Library that the exit tests preload. Every destructor of thread-specific data starts 1 to 5 ms late, so that a
// program ends while unjoined threads still run their destructors.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <threads.h>
#include <time.h>

enum { SLOTS = 100 };

typedef void (*destructor)(void*);

static destructor original[SLOTS];
static atomic_int used;

static void nap(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  const struct timespec length = {0, 1000000 + now.tv_nsec / 16 % 4000000};
  nanosleep(&length, NULL);
}

// a destructor receives the value and not the key, so that each slot has a separate function
#define SLOT(tens, ones)                       \
  static void slow_##tens##ones(void* value) { \
    nap();                                     \
    original[10 * tens + ones](value);         \
  }
#define NAME(tens, ones) slow_##tens##ones,
#define ROW(what, tens)                                                                                             \
  what(tens, 0) what(tens, 1) what(tens, 2) what(tens, 3) what(tens, 4) what(tens, 5) what(tens, 6) what(tens, 7) \
      what(tens, 8) what(tens, 9)
#define ALL(what) \
  ROW(what, 0) ROW(what, 1) ROW(what, 2) ROW(what, 3) ROW(what, 4) ROW(what, 5) ROW(what, 6) ROW(what, 7) ROW(what, 8) ROW(what, 9)

ALL(SLOT)
static const destructor slow[SLOTS] = {ALL(NAME)};

static destructor delayed(destructor function) {
  if (!function) {
    return NULL;
  }
  const int slot = atomic_fetch_add(&used, 1);
  if (slot >= SLOTS) {
    abort();
  }
  original[slot] = function;
  return slow[slot];
}

int pthread_key_create(pthread_key_t* key, destructor function) {
  static int (*next)(pthread_key_t*, destructor);
  if (!next) {
    next = (int (*)(pthread_key_t*, destructor))dlsym(RTLD_NEXT, "pthread_key_create");
  }
  return next(key, delayed(function));
}

int tss_create(tss_t* key, tss_dtor_t function) {
  static int (*next)(tss_t*, tss_dtor_t);
  if (!next) {
    next = (int (*)(tss_t*, tss_dtor_t))dlsym(RTLD_NEXT, "tss_create");
  }
  return next(key, delayed(function));
}
