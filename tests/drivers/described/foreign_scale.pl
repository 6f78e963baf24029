#!/usr/bin/perl
# A scale that answers "R" with its time (ms) and its position (mm), "W" with who it is: made of nothing but Perl.
# The file named by its argument says what it measures: "at MM", "lost", or "track" and then lines of seconds and mm, on which every
# reading is 40 ms later than the one before, with a noise of +-0.3 um.
use strict;
use Time::HiRes qw(clock_gettime CLOCK_MONOTONIC);
$| = 1;
$/ = "\r";
my ($file, $seen, $begin, @track) = ($ARGV[0], "", 0);
my $ms = int(1000 * clock_gettime(CLOCK_MONOTONIC));
while (my $question = <STDIN>) {
    my $inode = (stat $file)[1];
    if ($inode ne $seen) {
        open(my $in, "<", $file) or die;
        local $/ = "\n";
        @track = map { chomp; $_ } <$in>;
        ($seen, $begin) = ($inode, $ms);
    }
    if ($question eq "W\r") { print "SCALE 7 #0815\r\n"; next; }
    my ($word, $mm) = split " ", $track[0];
    if ($word eq "lost") { print "E 3\r\n"; next; }
    if ($word eq "at") { $ms = int(1000 * clock_gettime(CLOCK_MONOTONIC)); }
    else {
        $ms += 40;
        my ($s, $k) = (($ms - $begin) / 1000, 1);
        $k++ while $k < $#track and (split " ", $track[$k + 1])[0] <= $s;
        my ($s0, $mm0) = split " ", $track[$k];
        my ($s1, $mm1) = split " ", ($track[$k + 1] // "1e9 $mm0");
        $mm = $s < $s0 ? $mm0 : $mm0 + ($mm1 - $mm0) * ($s - $s0) / ($s1 - $s0);
        $mm += (rand(0.6) - 0.3) / 1000;
    }
    printf "%d %+.5f\r\n", $ms, $mm;
}
