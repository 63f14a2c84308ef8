/* What no shell can do with a file: keep it open, ask about it, and hear a signal meanwhile.
 *
 *     waits held FILE      fstat with a handler for SIGALRM; prints its result, errno, and how many signals there were
 *     waits counts FILE N  N times: fstat, then print the content, through the same descriptor
 *     waits synced FILE    write "first" and fsync; after a line on stdin write "second" and fsync; after one more, end
 *     waits locked FILE    take and leave both sorts of lock, and write "locked"
 *
 * They say "open" on stderr when others may look.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

static volatile sig_atomic_t signals;

static void heard(int number) { (void)number; signals++; }

static int held(int file) {
    struct sigaction action = {.sa_handler = heard};  /* without SA_RESTART: a call that can be interrupted is */
    struct stat found;
    sigaction(SIGALRM, &action, NULL);
    fputs("open\n", stderr);
    int result = fstat(file, &found);
    printf("%d %d %d\n", result, result ? errno : 0, (int)signals);
    return 0;
}

static int counts(int file, int n) {
    struct stat found;
    char text[4096];
    for (int k = 0; k < n; k++) {
        if (fstat(file, &found)) return 1;
        ssize_t size = pread(file, text, sizeof text, 0);
        if (size <= 0 || write(STDOUT_FILENO, text, (size_t)size) != size) return 1;
    }
    return 0;
}

static int synced(int file) {
    static const char *const texts[] = {"first\n", "second\n"};
    char line[8];
    for (int k = 0; k < 2; k++) {
        if (write(file, texts[k], strlen(texts[k])) < 0 || fsync(file)) return 1;
        fputs("open\n", stderr);
        if (!fgets(line, sizeof line, stdin)) return 1;
    }
    return 0;
}

static int locked(int file) {
    struct flock all = {.l_type = F_WRLCK, .l_whence = SEEK_SET};
    if (fcntl(file, F_GETLK, &all)) return 1;  /* with .u, Linux asks nobody, and changes nothing */
    all.l_type = F_WRLCK;
    if (fcntl(file, F_SETLKW, &all)) return 1;
    all.l_type = F_UNLCK;
    if (fcntl(file, F_SETLK, &all)) return 1;
    if (flock(file, LOCK_EX) || write(file, "locked\n", 7) != 7) return 1;  /* for 9P one sort excludes the other */
    return flock(file, LOCK_UN);
}

int main(int n, char **words) {
    if (n < 3) return 2;
    int locks = !strcmp(words[1], "locked"), writes = locks || !strcmp(words[1], "synced");
    int file = open(words[2], writes ? O_WRONLY | O_CREAT | O_TRUNC : O_RDONLY, 0644);
    if (file < 0) { perror(words[2]); return 1; }
    if (writes) return locks ? locked(file) : synced(file);
    return strcmp(words[1], "counts") ? held(file) : counts(file, n > 3 ? atoi(words[3]) : 1);
}
