#define M2T(milliseconds) (milliseconds)
