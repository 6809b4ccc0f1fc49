#!/bin/sh
# Start a SLURM of one node on the loopback interface, as root on Debian or Ubuntu: up.sh DIR
# Everything but the packages is in DIR, an absolute path: configuration, logs, and a .pid file for each of the three
# daemons, to stop them by. With SLURM_CONF=DIR/slurm.conf, sinfo, srun and sbatch use it.
set -e
here=$(cd "$(dirname "$0")" && pwd)
dir=$1
if ! command -v slurmctld slurmd sbatch munged >/dev/null; then
    if [ ! -e /usr/sbin/policy-rc.d ]; then # installing must not start the services
        printf '#!/bin/sh\nexit 101\n' >/usr/sbin/policy-rc.d && chmod +x /usr/sbin/policy-rc.d
        trap 'rm -f /usr/sbin/policy-rc.d' EXIT
    fi
    packages="slurmctld slurmd slurm-client munge"
    apt-get install -y -qq --no-install-recommends $packages ||
        { apt-get update -qq && apt-get install -y -qq --no-install-recommends $packages; }
fi
mkdir -p "$dir/state" "$dir/spool"
chmod 755 "$dir"
for file in slurm.conf cgroup.conf; do
    sed "s#HOST#$(hostname -s)#g; s#DIR#$dir#g" "$here/$file" >"$dir/$file"
done
export SLURM_CONF="$dir/slurm.conf"
head -c 1024 /dev/urandom >"$dir/munge.key" && chmod 400 "$dir/munge.key"
munged --force --key-file="$dir/munge.key" --socket="$dir/munge.socket" --pid-file="$dir/munged.pid" \
    --log-file="$dir/munged.log" --seed-file="$dir/munged.seed"
slurmctld -c -f "$SLURM_CONF" >/dev/null 2>&1
slurmd -f "$SLURM_CONF"
for _ in 1 2 3 4 5 6 7 8 9 10; do
    sleep 1
    timeout 5 srun -n1 true 2>/dev/null && exit 0
done
echo "no job could be run within 60 s; the logs are in $dir" >&2
exit 1
