// One variable of the environment for the time in which an OpenGL driver starts.
//
// `setenv` frees the array that other threads may be reading (`getenv` takes no lock). Here nothing is ever freed or moved: a
// copy of the array with one more entry at its end becomes the environment, and stays it after that entry has been cut off.
#define _GNU_SOURCE  // environ

#include "shim.h"

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define VARIABLE "LP_NUM_THREADS"

static char entry[] = VARIABLE "=0";
static char** copy = NULL;
static size_t end = 0;  // where the entry stands in the copy

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
  // where another thread has just exchanged the array, its own stands, and the rasteriser starts its threads
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
    // another thread has set a variable meanwhile, in an array of its own that has this entry in its middle
    for (char** variable = now; variable && *variable; variable++) {
      if (*variable == entry) {
        unsetenv(VARIABLE);
        break;
      }
    }
  }
  copy = NULL;
}
