/* Preloaded, lets every read of a part of one file end with EIO, as a bad block of a disk does.

   BAD_FILE is its path, BAD_FROM and BAD_TO the bytes that cannot be read. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

static int is_bad(int descriptor, off_t at, size_t count)
{
    const char *name = getenv("BAD_FILE");
    struct stat wanted, found;
    if (!name || at < 0 || at >= atoll(getenv("BAD_TO")) || at + (off_t)count <= atoll(getenv("BAD_FROM")))
        return 0;
    return !stat(name, &wanted) && !fstat(descriptor, &found) && wanted.st_ino == found.st_ino
           && wanted.st_dev == found.st_dev;
}

size_t fread(void *buffer, size_t size, size_t count, FILE *stream)
{
    static size_t (*original)(void *, size_t, size_t, FILE *);
    if (!original)
        original = dlsym(RTLD_NEXT, "fread");
    if (is_bad(fileno(stream), ftello(stream), size * count)) {
        stream->_flags |= 0x20; /* what ferror() of glibc looks at */
        errno = EIO;
        return 0;
    }
    return original(buffer, size, count, stream);
}

ssize_t read(int descriptor, void *buffer, size_t count)
{
    static ssize_t (*original)(int, void *, size_t);
    if (!original)
        original = dlsym(RTLD_NEXT, "read");
    if (is_bad(descriptor, lseek(descriptor, 0, SEEK_CUR), count)) {
        errno = EIO;
        return -1;
    }
    return original(descriptor, buffer, count);
}

ssize_t pread64(int descriptor, void *buffer, size_t count, off_t at)
{
    static ssize_t (*original)(int, void *, size_t, off_t);
    if (!original)
        original = dlsym(RTLD_NEXT, "pread64");
    if (is_bad(descriptor, at, count)) {
        errno = EIO;
        return -1;
    }
    return original(descriptor, buffer, count, at);
}
