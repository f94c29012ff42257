#!/usr/bin/env bash
# Starts a real Slurm of two nodes on this host, as root, with a folder for its files: tests/slurm_here.sh FOLDER
# SLURM_HERE_CPUS says how many cores each node claims to have, 2 by default.
# Prints SLURM_CONF=FILE. `tests/slurm_here.sh FOLDER stop` ends what it started. It needs Debian's slurm-wlm and munge.
set -euo pipefail
folder=$(mkdir -p "$1" && cd "$1" && pwd)
if [ "${2:-}" = stop ]; then
  for file in "$folder"/*.pid; do [ -e "$file" ] && kill "$(cat "$file")" 2>/dev/null || true; done
  exit 0
fi
mkdir -p "$folder"/{state,spooln1,spooln2} /run/munge
[ -s /etc/munge/munge.key ] || /usr/sbin/mungekey -f
chown -R munge: /etc/munge /run/munge /var/lib/munge /var/log/munge
[ -S /run/munge/munge.socket.2 ] || runuser -u munge -- /usr/sbin/munged --force >/dev/null 2>&1
host=$(hostname -s)
cat > "$folder/slurm.conf" <<END
ClusterName=here
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
CryptoType=crypto/munge
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool%n
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd%n.pid
SlurmctldPort=17817
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
ReturnToService=2
MpiDefault=none
JobRequeue=1
KillWait=5
SlurmdParameters=config_overrides
SchedulerParameters=sched_min_interval=100000
NodeName=n1 NodeHostname=$host NodeAddr=127.0.0.1 Port=17818 CPUs=${SLURM_HERE_CPUS:-2} RealMemory=4000 State=UNKNOWN
NodeName=n2 NodeHostname=$host NodeAddr=127.0.0.1 Port=17819 CPUs=${SLURM_HERE_CPUS:-2} RealMemory=4000 State=UNKNOWN
PartitionName=main Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
END
export SLURM_CONF=$folder/slurm.conf
slurmctld -L "$folder/slurmctld.log"
for node in n1 n2; do nice -n 10 slurmd -N "$node" -L "$folder/$node.log"; done
for _ in $(seq 60); do
  [ "$(sinfo -h -N -t idle 2>/dev/null | wc -l)" = 2 ] && break
  sleep 0.5
done
sinfo -N >&2
echo "SLURM_CONF=$SLURM_CONF"
