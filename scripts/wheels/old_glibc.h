/* Included before every source of a shipped library, so that it runs on systems with glibc 2.27.

Functions that got a new version in a later glibc are taken in their first one; only errno differs.
libstdc++ asks a variable of glibc 2.32 whether there are threads: there are (the definition below is
private to the library, and weak, since every unit has it). */

__asm__(".symver exp, exp@GLIBC_2.2.5");
__asm__(".symver log, log@GLIBC_2.2.5");
__asm__(".symver pow, pow@GLIBC_2.2.5");
__asm__(".symver expf, expf@GLIBC_2.2.5");
__asm__(".symver logf, logf@GLIBC_2.2.5");

extern "C" __attribute__((visibility("hidden"), weak)) char __libc_single_threaded = 0;
