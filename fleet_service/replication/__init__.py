"""Ownership of an archive: lease, bucket replica and fence of former owners.

One service at a time owns an archive. `ownership` locks the folder, waits for the `lease` of the
bucket, lets the `replica` make folder and bucket equal, and puts a `fence` before it serves.
`archive/` knows nothing of this room: the segment log calls `BucketReplica.upload_segments` through
a callback.

**States of one service.**

| state | event | next state | action |
|---|---|---|---|
| waiting | no lease exists, or it was released, for this service or for any | taking | create the next number |
| waiting | the lease was held by an earlier start of this folder | taking | create the next number |
| waiting | the same turn for `lease_s` (HINT of it if the holder's token fell) | taking | create the next number |
| waiting | any other look | waiting | a standby downloads new objects |
| taking | another service created the number first | waiting | |
| taking | created, and the former turn is the one seen last | joining | |
| taking | created, but the former holder renewed meanwhile | joining | wait for `lease_s` first |
| joining | folder and bucket are equal, and the fence is put | holding | serve and acknowledge |
| joining | a higher number exists | waiting | |
| joining | the bucket does not answer | joining | a standby retries, another service stops |
| holding | renewed within `lease_s / 2` | holding | |
| holding | no valid renewal for `lease_s / 2` | silent | acknowledge nothing; uploads and renewals continue |
| silent | a renewal is valid again | holding | |
| holding, silent | a higher number exists, or a successor's tokens appear while silent | lost | stop |
| holding, silent | the service stops or hands over | released | write `released`, for any or for the named standby |

**Invariants.** (1) At most one service is in `holding` with a right to acknowledge. (2) Every
acknowledged row is in the bucket before the next owner lists it. (3) Objects of a former owner that
are not in the fence count for no reader, and no sender was told that they were safe. The argument
for (1) and (2) is in `lease`, that for (3) in `fence`.
"""
