// Sets one environment variable while an OpenGL driver starts.
//
// `setenv` frees the array that other threads may be reading (`getenv` takes no lock). This code frees and moves
// nothing: a copy of the array with one more entry at its end becomes the environment, and stays the environment
// after the entry is removed.
#define _GNU_SOURCE  // environ

#include "shim.h"

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define VARIABLE "LP_NUM_THREADS"

static char entry[] = VARIABLE "=0";
static char** copy = NULL;
static size_t end = 0;  // index of the entry in the copy

void mjshim_without_rasteriser_threads(void) {
  if (getenv(VARIABLE)) {
    return;
  }
  char** old = __atomic_load_n(&environ, __ATOMIC_ACQUIRE);
  size_t count = 0;
  while (old && old[count]) {
    count++;
  }
  char** const larger = malloc((count + 2) * sizeof(char*));
  if (!larger) {
    return;
  }
  if (count) {
    memcpy(larger, old, count * sizeof(char*));
  }
  larger[count] = entry;
  larger[count + 1] = NULL;
  // if another thread has just replaced the array, its array stays, and the rasterizer starts its threads
  if (!__atomic_compare_exchange_n(&environ, &old, larger, 0, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE)) {
    free(larger);
    return;
  }
  copy = larger;
  end = count;
}

void mjshim_restore_environment(void) {
  if (!copy) {
    return;
  }
  char** const now = __atomic_load_n(&environ, __ATOMIC_ACQUIRE);
  if (now == copy && copy[end] == entry && !copy[end + 1]) {
    __atomic_store_n(&copy[end], NULL, __ATOMIC_RELEASE);
  } else {
    // another thread has called setenv since; its array contains this entry before its own
    for (char** variable = now; variable && *variable; variable++) {
      if (*variable == entry) {
        unsetenv(VARIABLE);
        break;
      }
    }
  }
  copy = NULL;
}
