// The end of a program's library. Comes after the table of the program.
#ifndef DRIVER
API Program* pd_program(void* const* shared) {  // the driver's functions
#define EACH(result, name, ...) name = (result (*)(__VA_ARGS__))*shared++;
  SHARED(EACH)
#undef EACH
  return &PROGRAM;
}
#endif
