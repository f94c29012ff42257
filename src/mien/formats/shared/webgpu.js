"use strict";var mienWebGpu=(()=>{var N=Object.defineProperty;var re=Object.getOwnPropertyDescriptor;var te=Object.getOwnPropertyNames;var ae=Object.prototype.hasOwnProperty;var oe=(s,e)=>{for(var r in e)N(s,r,{get:e[r],enumerable:!0})},ne=(s,e,r,t)=>{if(e&&typeof e=="object"||typeof e=="function")for(let a of te(e))!ae.call(s,a)&&a!==r&&N(s,a,{get:()=>e[a],enumerable:!(t=re(e,a))||t.enumerable});return s};var se=s=>ne(N({},"__esModule",{value:!0}),s);var de={};oe(de,{findBackend:()=>fe});function I({neutral:s,basis:e,biases:r},t){return{width:s.length/Math.max(t,1),rank:e.length/Math.max(s.length,1),hidden:r[0].length}}function C({own:s,weights:e,biases:r},t,a){let o=r[0].length,n=s.length/Math.max(t,1),u=new Float32Array(t*o);for(let l=0;l<t;++l)for(let i=0;i<o;++i){let c=r[0][i];for(let f=0,h=i*(a+n)+a;f<n;++f)c+=e[0][h+f]*s[l*n+f];u[l*o+i]=c}return u}function z({rest:s,directions:e,shares:r,head:t},a){let o=r?r.length/Math.max(a,1):1,n=e.length/s.length/o;return{regions:o,own:n,width:n+(t?t.directions.length/6:0)}}var A=class extends Error{};var ye=1<<27,ve=1<<23;var k=class{constructor(e){this.device=e;this.buffers=[]}storage(e,r=0){let{STORAGE:t,COPY_SRC:a}=GPUBufferUsage,{maxStorageBufferBindingSize:o,maxBufferSize:n}=this.device.limits,u=4*(typeof e=="number"?e:e.length);if(u>Math.min(o,n))throw new A("has more Gaussians than this device can hold");let l=this.buffer(u,t|a|r);return typeof e!="number"&&this.write(l,e),l}indirect(e){return this.storage(e,GPUBufferUsage.INDIRECT)}uniform(e){return this.buffer(4*e,GPUBufferUsage.UNIFORM)}write(e,r){this.device.queue.writeBuffer(e,0,r)}group(e,r){return this.device.createBindGroup({layout:e,entries:r.map((t,a)=>({binding:a,resource:{buffer:t}}))})}free(){for(let e of this.buffers)e.destroy()}buffer(e,r){let t=this.device.createBuffer({size:Math.max(64,e),usage:r|GPUBufferUsage.COPY_DST});return this.buffers.push(t),t}};function x(s,e,r,t){s.setPipeline(e),s.setBindGroup(0,r),s.dispatchWorkgroups(t)}var g=256,w=1024,E=256,S=`
struct Pose{
count:u32,triangles:u32,columns:u32,
bias:vec4f,
activations:array<vec4f,${E/4}>,
}
@group(0)@binding(0)var<uniform>pose:Pose;`,O=(s,e,r)=>`
@group(0)@binding(${r})var<storage,read>shares:array<f32>;
fn activation(triangle:u32,k:u32)->f32{
var sum=0.;
for(var g=0u;g<${s};g++){
let at=g*${e}+k;
sum+=shares[triangle*${s}+g]*pose.activations[at>>2][at&3];
}
return sum;
}`,D=`${S}
@group(0)@binding(1)var<storage,read>points:array<f32>;
@group(0)@binding(2)var<storage,read>faces:array<u32>;
@group(0)@binding(3)var<storage,read_write>frames:array<vec4f>;
const DEGENERATE_LENGTH=1e-7;
fn at(i:u32)->vec3f{return vec3f(points[3*i],points[3*i+1],points[3*i+2]);}

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u){
let f=id.x;
if(f>=pose.triangles){return;}
let a=at(faces[3*f]);let b=at(faces[3*f+1]);let c=at(faces[3*f+2]);
var first=b-a;
var side=c-a;
var edge=length(first);
if(edge<DEGENERATE_LENGTH||length(cross(first,side))<DEGENERATE_LENGTH*edge){
first=vec3f(DEGENERATE_LENGTH,0,0);
side=vec3f(0,DEGENERATE_LENGTH,0);
edge=DEGENERATE_LENGTH;
}
first/=edge;
var normal=cross(first,side);
let height=length(normal);let k=(edge+height)/2;
normal/=height;
let last=cross(first,normal);let middle=(a+b+c)/3;
for(var row=0u;row<3;row++){frames[3*f+row]=vec4f(k*first[row],k*normal[row],k*last[row],middle[row]);}
}`,$=(s,e)=>`${S}${O(s,e,6)}
@group(0)@binding(1)var<storage,read>restMeans:array<vec4f>;
@group(0)@binding(2)var<storage,read>restColors:array<vec4f>;
@group(0)@binding(3)var<storage,read>basis:array<vec4f>;
@group(0)@binding(4)var<storage,read_write>means:array<vec4f>;
@group(0)@binding(5)var<storage,read_write>colors:array<vec4f>;

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u){
let i=id.x;
if(i>=pose.count){return;}
var mean=restMeans[i];
var color=restColors[i];
for(var k=0u;k<pose.columns;k++){
let a=activation(u32(mean.w),k);let first=basis[2*(i*pose.columns+k)];
mean+=a*vec4f(first.xyz,0);
color+=a*vec4f(basis[2*(i*pose.columns+k)+1].xyz,first.w);
}
means[i]=mean;
colors[i]=color;
}`;function j(s,e,r,t){return`${S}${O(t,e,6)}
@group(0)@binding(1)var<storage,read>neutral:array<vec2u>;
@group(0)@binding(2)var<storage,read>basis:array<vec2u>;
@group(0)@binding(3)var<storage,read>own:array<vec2u>;
@group(0)@binding(4)var<storage,read>weights:array<vec4f>;
@group(0)@binding(5)var<storage,read_write>colors:array<vec4f>;
@group(0)@binding(7)var<storage,read>means:array<vec4f>;
fn four(halves:vec2u)->vec4f{return vec4f(unpack2x16float(halves.x),unpack2x16float(halves.y));}

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u){
let i=id.x;
if(i>=pose.count){return;}
let triangle=u32(means[i].w);
var f:array<vec4f,${s}>;
for(var t=0u;t<${s};t++){f[t]=four(neutral[i*${s}+t]);}
for(var k=0u;k<${e};k++){
let a=activation(triangle,k);
if(a !=0){
for(var t=0u;t<${s};t++){f[t]+=a*four(basis[(i*${e}+k)*${s}+t]);}
}
}
var sum=pose.bias;
for(var h=0u;h<${r};h++){
let w=h*${s+1};
var x=four(own[i*${r/4}+(h>>2)])[h&3];
for(var t=0u;t<${s};t++){x+=dot(weights[w+t],f[t]);}
sum+=weights[w+${s}]*select(x,${.01}*x,x<0);
}
colors[i]+=sum;
}`}var F=`
struct View{
head:array<vec4f,3>,
directions:array<vec4f,3>,
focal:vec2f,centre:vec2f,size:vec2f,
count:u32,shRest:u32,
background:vec4f,
}`,V=`
struct Splat{
place:vec4f,
shape:vec4f,
color:vec4f,
}`,q="near:NUMBER,far:NUMBER,vertices:u32,visible:NUMBER,firstVertex:u32,firstInstance:u32",H=`${F}${V}
struct State{${q.replace(/NUMBER/g,"atomic<u32>")}}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>frames:array<vec4f>;
@group(0)@binding(2)var<storage,read>means:array<vec4f>;
@group(0)@binding(3)var<storage,read>shapes:array<vec4f>;
@group(0)@binding(4)var<storage,read>colors:array<vec4f>;
@group(0)@binding(5)var<storage,read>sh:array<vec4f>;
@group(0)@binding(6)var<storage,read_write>splats:array<Splat>;
@group(0)@binding(7)var<storage,read_write>keys:array<u32>;
@group(0)@binding(8)var<storage,read_write>state:State;
var<workgroup>near:atomic<u32>;
var<workgroup>far:atomic<u32>;
var<workgroup>visible:atomic<u32>;
const NEAR=0.01;
const DILATION=0.3;
const FOV_MARGIN=0.3;
const LOG2_ALPHA_MIN=-7.9943533;
const HALF_LOG2E=0.7213475;
const UNSEEN=0xffffffffu;

fn turn(quaternion:vec4f)->mat3x3f{
let q=normalize(quaternion);
let w=q.x;let x=q.y;let y=q.z;let z=q.w;
return mat3x3f(1.-2.*(y*y+z*z),2.*(x*y+w*z),2.*(x*z-w*y),
2.*(x*y-w*z),1.-2.*(x*x+z*z),2.*(y*z+w*x),
2.*(x*z+w*y),2.*(y*z-w*x),1.-2.*(x*x+y*y));
}

fn shRest(i:u32,d:vec3f)->vec3f{
let x=d.x;let y=d.y;let z=d.z;let xx=x*x;let yy=y*y;let zz=z*z;
let s=i*view.shRest;
var c=-0.48860252*y*sh[s].rgb+0.48860252*z*sh[s+1].rgb-0.48860252*x*sh[s+2].rgb;
if(view.shRest>3){
c+=1.0925485*x*y*sh[s+3].rgb-1.0925485*y*z*sh[s+4].rgb
+0.31539157*(2.*zz-xx-yy)*sh[s+5].rgb-1.0925485*x*z*sh[s+6].rgb
+0.54627424*(xx-yy)*sh[s+7].rgb;
}
if(view.shRest>8){
c+=-0.5900436*y*(3.*xx-yy)*sh[s+8].rgb+2.8906114*x*y*z*sh[s+9].rgb
-0.4570458*y*(4.*zz-xx-yy)*sh[s+10].rgb
+0.37317634*z*(2.*zz-3.*xx-3.*yy)*sh[s+11].rgb
-0.4570458*x*(4.*zz-xx-yy)*sh[s+12].rgb
+1.4453057*z*(xx-yy)*sh[s+13].rgb-0.5900436*x*(xx-3.*yy)*sh[s+14].rgb;
}
return c;
}


fn project(i:u32)->u32{
let color=colors[i];
let mean=means[i];
let f=3*u32(mean.w);
let a=frames[f];let b=frames[f+1];let c=frames[f+2];
let local=vec4f(mean.xyz,1);
let head=vec4f(dot(a,local),dot(b,local),dot(c,local),1);
let v=view.head;
let p=vec3f(dot(v[0],head),dot(v[1],head),dot(v[2],head));
let log2Opacity=-log2(1.+exp(min(-color.a,80.)));
if(p.z<=NEAR||log2Opacity<LOG2_ALPHA_MIN){return UNSEEN;}
let tangent=p.xy/p.z;
let margin=FOV_MARGIN*.5*view.size/view.focal;
let centre=view.focal*tangent+view.centre;
let clamped=clamp(tangent,-view.centre/view.focal-margin,(view.size-view.centre)/view.focal+margin);
let j=view.focal/p.z;
let n0=j.x*(v[0].xyz-clamped.x*v[2].xyz);
let n1=j.y*(v[1].xyz-clamped.y*v[2].xyz);
let frame=transpose(mat3x3f(a.xyz,b.xyz,c.xyz))*turn(shapes[2*i]);
let scale=shapes[2*i+1].xyz;
let u0=(n0*frame)*scale;let u1=(n1*frame)*scale;let area=cross(u0,u1);
var xx=dot(u0,u0);var yy=dot(u1,u1);let xy=dot(u0,u1);
let determinant=dot(area,area)+DILATION*(xx+yy)+DILATION*DILATION;
xx+=DILATION;yy+=DILATION;
if(!(xx<1e30&&yy<1e30&&determinant<1e30)){return UNSEEN;}

let reach=sqrt(max((log2Opacity-LOG2_ALPHA_MIN)*1.3862944,0.))+.1;
let box=reach*sqrt(vec2f(xx,yy));
if(any(centre+box<vec2f(0))||any(centre-box>view.size)){return UNSEEN;}
var rgb=0.5+0.2820948*color.rgb;
if(view.shRest>0){
let eye=-(v[0].w*v[0].xyz+v[1].w*v[1].xyz+v[2].w*v[2].xyz);
let d=normalize(head.xyz-eye);let t=view.directions;
rgb+=shRest(i,vec3f(dot(t[0].xyz,d),dot(t[1].xyz,d),dot(t[2].xyz,d)));
}
splats[i]=Splat(vec4f(centre,xy/yy,log2Opacity),
vec4f(sqrt(yy/determinant*HALF_LOG2E),sqrt(HALF_LOG2E/yy),sqrt(determinant/yy),sqrt(yy)),vec4f(max(rgb,vec3f(0)),reach));
return bitcast<u32>(p.z);
}

@compute @workgroup_size(${g})
fn main(@builtin(global_invocation_id)id:vec3u,@builtin(local_invocation_index)thread:u32){
if(thread==0){atomicStore(&near,UNSEEN);}
workgroupBarrier();
let i=id.x;
if(i<view.count){
let key=project(i);
keys[i]=key;
if(key !=UNSEEN){
atomicMin(&near,key);
atomicMax(&far,key);
atomicAdd(&visible,1);
}
}
workgroupBarrier();
if(thread==0&&atomicLoad(&visible)>0){
atomicMin(&state.near,atomicLoad(&near));
atomicMax(&state.far,atomicLoad(&far));
atomicAdd(&state.visible,atomicLoad(&visible));
}
}`,X=`${F}
struct State{${q.replace(/NUMBER/g,"u32")}}
override FIRST:bool;
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>state:State;
@group(0)@binding(2)var<storage,read>keysIn:array<u32>;
@group(0)@binding(3)var<storage,read>orderIn:array<u32>;
@group(0)@binding(4)var<storage,read_write>keysOut:array<u32>;
@group(0)@binding(5)var<storage,read_write>orderOut:array<u32>;
@group(0)@binding(6)var<storage,read_write>starts:array<u32>;
var<workgroup>counts:array<atomic<u32>,256>;
var<workgroup>sums:array<u32,256>;
var<workgroup>masks:array<atomic<u32>,2048>;

fn keyOf(i:u32)->u32{
let key=keysIn[i];
if(!FIRST){return key;}
if(key==0xffffffffu){return 65535;}
let near=bitcast<f32>(state.near);let far=bitcast<f32>(state.far);
return min(u32((far-bitcast<f32>(key))*(65535/max(far-near,1e-20))),65534);
}

fn digitOf(key:u32)->u32{return select(key>>8,key&255,FIRST);}

@compute @workgroup_size(${g})
fn count(@builtin(workgroup_id)group:vec3u,@builtin(local_invocation_index)thread:u32){
for(var round=0u;round<${w/g};round++){
let i=group.x*${w}+round*${g}+thread;
if(i<view.count){atomicAdd(&counts[digitOf(keyOf(i))],1);}
}
workgroupBarrier();
starts[group.x*256+thread]=atomicLoad(&counts[thread]);
}


@compute @workgroup_size(${g})
fn scan(@builtin(local_invocation_index)thread:u32){
let end=(view.count+${w-1})/${w}*256;
var sum=0u;
for(var k=thread;k<end;k+=256){sum+=starts[k];}
sums[thread]=sum;
workgroupBarrier();
var before=0u;
for(var digit=0u;digit<thread;digit++){before+=sums[digit];}
for(var k=thread;k<end;k+=256){
let here=starts[k];
starts[k]=before;
before+=here;
}
}

@compute @workgroup_size(${g})
fn scatter(@builtin(workgroup_id)group:vec3u,@builtin(local_invocation_index)thread:u32){
let word=thread>>5;let bit=1u<<(thread&31);
sums[thread]=starts[group.x*256+thread];
for(var round=0u;round<${w/g};round++){
for(var k=thread*8;k<thread*8+8;k++){atomicStore(&masks[k],0);}
workgroupBarrier();
let i=group.x*${w}+round*${g}+thread;let valid=i<view.count;
var key=0u;var digit=0u;
if(valid){
key=keyOf(i);
digit=digitOf(key);
atomicOr(&masks[digit*8+word],bit);
}
workgroupBarrier();
if(valid){
var to=sums[digit]+countOneBits(atomicLoad(&masks[digit*8+word])&(bit-1));
for(var k=digit*8;k<digit*8+word;k++){to+=countOneBits(atomicLoad(&masks[k]));}
if(FIRST){
keysOut[to]=key;
orderOut[to]=i;
}else{orderOut[to]=orderIn[i];}
}
workgroupBarrier();
for(var k=thread*8;k<thread*8+8;k++){sums[thread]+=countOneBits(atomicLoad(&masks[k]));}
}
}`,W=`${F}${V}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>splats:array<Splat>;
@group(0)@binding(2)var<storage,read>order:array<u32>;
struct Corner{
@builtin(position)position:vec4f,
@location(0)@interpolate(flat)place:vec4f,
@location(1)@interpolate(flat)roots:vec2f,
@location(2)@interpolate(flat)color:vec3f,
}

@vertex fn corner(@builtin(vertex_index)vertex:u32,@builtin(instance_index)instance:u32)->Corner{
let s=splats[order[instance]];
let at=s.color.a*(vec2f(f32(vertex&1),f32(vertex>>1))*2.-1.)*s.shape.zw;
let pixel=s.place.xy+vec2f(s.place.z*at.y+at.x,at.y);
return Corner(vec4f(2.*pixel.x/view.size.x-1.,1.-2.*pixel.y/view.size.y,0,1),s.place,s.shape.xy,s.color.rgb);
}

@fragment fn blend(c:Corner)->@location(0)vec4f{
let d=c.position.xy-c.place.xy;
let r=c.roots*vec2f(d.x-c.place.z*d.y,d.y);
let power=c.place.w-dot(r,r);
if(power<-7.9943533){discard;}
let alpha=min(exp2(power),0.999);
return vec4f(c.color*alpha,alpha);
}`,Y=`${F}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var picture:texture_2d<f32>;

@vertex fn corner(@builtin(vertex_index)vertex:u32)->@builtin(position)vec4f{
return vec4f(vec2f(f32(vertex&1),f32(vertex>>1))*4.-1.,0,1);
}

@fragment fn show(@builtin(position)at:vec4f)->@location(0)vec4f{
var c=textureLoad(picture,vec2i(at.xy),0);
c+=(1.-c.a)*view.background;
return vec4f(clamp(c.rgb,vec3f(0),vec3f(c.a)),c.a);
}`;var K=8,P=class{constructor(e,r,t,a,o){this.memory=e;this.changes=[];let{rig:n,faces:u,changes:l}=r,i=r.face_index.length,c=u.length/3;this.points=e.storage(n.template.length),this.told=new Float32Array(K+E),this.pose=e.uniform(this.told.length);let f=new Uint32Array(this.told.buffer);if(f[0]=i,f[1]=c,this.frames=this.step(D,c,[this.pose,this.points,e.storage(u),t.frames]),!l)return;let{regions:h,width:m}=z(l,c);if(h*m>E)throw new A(`has more than ${E} activations`);let p=e.storage(l.shares??new Float32Array(c).fill(1)),{basis:y,columns:d}=ie(l,i);f[2]=d;let v=[a,o].map(b=>e.storage(b));this.changes.push(this.step($(h,m),i,[this.pose,...v,e.storage(y),t.means,t.colors,p])),l.features&&this.addNetwork(l.features,i,h,[t.colors,p,t.means])}run(e){let{device:r}=this.memory;this.memory.write(this.points,e.points);let t=r.createCommandEncoder(),a=t.beginComputePass(),o=[this.frames];e.changed&&(this.told.set(e.activations,K),o.push(...this.changes)),this.memory.write(this.pose,this.told);for(let{pipeline:n,group:u,threads:l}of o)x(a,n,u,Math.ceil(l/g));a.end(),r.queue.submit([t.finish()])}addNetwork(e,r,t,a){let{memory:o}=this,{width:n,rank:u,hidden:l}=I(e,r),{weights:i,biases:c}=e,f=Math.ceil(n/4),h=4*Math.ceil(l/4),m=i[0].length/l,p=new Float32Array(4*(f+1)*h);for(let b=0;b<l;++b){let T=4*(f+1)*b;p.set(i[0].subarray(b*m,b*m+n),T);for(let _=0;_<4;++_)p[T+4*f+_]=i[1][_*l+b]}this.told.set(c[1],4);let y=(b,T)=>o.storage(ue(le(b,T))),d=y(C(e,r,n),l),v=[y(e.neutral,n),y(e.basis,n),d,o.storage(p)];this.changes.push(this.step(j(f,u,h,t),r,[this.pose,...v,...a]))}step(e,r,t){let{device:a}=this.memory,o=a.createComputePipeline({layout:"auto",compute:{module:a.createShaderModule({code:e})}});return{pipeline:o,group:this.memory.group(o.getBindGroupLayout(0),t),threads:r}}};function ie({means:s,opacity_logits:e,color:r},t){let a=[{part:s,width:3,at:0},{part:e,width:1,at:3},{part:r,width:3,at:4}],o=(l,i)=>(l?.length??0)/i/Math.max(t,1),n=Math.max(...a.map(({part:l,width:i})=>o(l,i))),u=new Float32Array(8*t*n);for(let{part:l,width:i,at:c}of a){let f=o(l,i);for(let h=0,m=0;h<t;++h)for(let p=0;p<i;++p)for(let y=0;y<f;++y)u[8*(h*n+y)+c+p]=l[m++]}return{basis:u,columns:n}}function le(s,e){let r=4*Math.ceil(e/4),t=s.length/e;if(r===e)return s;let a=new Float32Array(t*r);for(let o=0;o<t;++o)a.set(s.subarray(o*e,(o+1)*e),o*r);return a}function ue(s){if(typeof Float16Array>"u")throw new A("needs half floats, which this browser's WebGPU lacks");return new Uint32Array(new Float16Array(s).buffer)}var R=class{constructor(e){let r=["uniform",...Array(3).fill("read-only-storage"),...Array(3).fill("storage")];this.layout=e.createBindGroupLayout({entries:r.map((o,n)=>({binding:n,visibility:GPUShaderStage.COMPUTE,buffer:{type:o}}))});let t=e.createPipelineLayout({bindGroupLayouts:[this.layout]}),a=e.createShaderModule({code:X});this.digits=[1,0].map(o=>{let n=u=>e.createComputePipeline({layout:t,compute:{module:a,entryPoint:u,constants:{FIRST:o}}});return{count:n("count"),scan:n("scan"),scatter:n("scatter")}})}},U=class{constructor(e,r,t,a,o){this.pipelines=e;this.count=t;let[n,u,l,i]=Array.from({length:4},()=>r.storage(t)),c=r.storage(256*Math.ceil(t/w)),f=[[n,u,l,i],[l,i,n,u]];this.groups=f.map(h=>r.group(e.layout,[a,o,...h,c])),[this.keys,this.order]=[n,u]}run(e){let r=Math.ceil(this.count/w);this.pipelines.digits.forEach(({count:t,scan:a,scatter:o},n)=>{let u=this.groups[n];x(e,t,u,r),x(e,a,u,1),x(e,o,u,r)})}};function G(s,e){for(let r=0,t=0;r<s.length;r+=3,t+=4)e[t]=s[r],e[t+1]=s[r+1],e[t+2]=s[r+2]}var Q="rgba16float",J=36,Z=Uint32Array.of(4294967295,0,4,0,0,0),ce=8,B=class{constructor(e,r){this.device=e;this.format=r;let t=n=>e.createShaderModule({code:n});this.project=e.createComputePipeline({layout:"auto",compute:{module:t(H)}}),this.sort=new R(e);let a={srcFactor:"one",dstFactor:"one-minus-src-alpha"},o=(n,u,l)=>{let i=t(n);return e.createRenderPipeline({layout:"auto",vertex:{module:i},fragment:{module:i,targets:[u]},primitive:{topology:l}})};this.draw=o(W,{format:Q,blend:{color:a,alpha:a}},"triangle-strip"),this.screen=o(Y,{format:r},"triangle-list")}},M=class{constructor(e,r,t,a){this.pipelines=e;this.context=r;this.poser=a;this.picture=null;this.screen=null;let{device:o}=e,{attributes:n}=t.baked,{bound:u,faceIndex:l}=a,i=this.memory=new k(o),c=this.count=l.length;this.shRest=n.sh.length/3/Math.max(c,1)-1,[this.means,this.colors,this.shapeValues]=[4,4,8].map(d=>new Float32Array(d*c)),l.forEach((d,v)=>this.means[4*v+3]=d),G(a.means,this.means);for(let d=0;d<c;++d){let v=3*d*(1+this.shRest);this.colors.set([...n.sh.subarray(v,v+3),n.opacity_logits[d]],4*d)}let f=new Float32Array(4*c*this.shRest);for(let d=0;d<c*this.shRest;++d){let v=3*(d+Math.floor(d/this.shRest)+1);f.set(n.sh.subarray(v,v+3),4*d)}let h=this.posed={frames:i.storage(a.frames.length),means:i.storage(this.means),colors:i.storage(this.colors)};this.shapes=i.storage(8*c),this.view=i.uniform(J),this.state=i.indirect(Z),this.sorter=new U(e.sort,i,c,this.view,this.state);let m=i.storage(12*c),p=this.sorter,y=[h.frames,h.means,this.shapes,h.colors,i.storage(f)];this.project=i.group(e.project.getBindGroupLayout(0),[this.view,...y,m,p.keys,this.state]),this.splats=i.group(e.draw.getBindGroupLayout(0),[this.view,m,p.order]),this.uploadShapes(n.quats,n.log_scales.map(Math.exp)),this.gpuPoser=u&&new P(i,u,h,this.means,this.colors),r.configure({device:o,format:e.format,alphaMode:"premultiplied"})}upload(){let{gpuPoser:e,poser:r}=this;e?.run(r),r.free&&this.uploadPosed(r,r.free)}draw(e,r,t){let{pipelines:a,count:o}=this,{device:n}=a,[u,l,i,c]=t,f=r.directions,h=new Float32Array(J);h.set(r.head),h.set([f[0],f[1],f[2],0,f[3],f[4],f[5],0,f[6],f[7],f[8]],12),h.set([...r.focal,...r.centre,r.width,r.height],24),new Uint32Array(h.buffer).set([o,this.shRest],30),h.set([u*c,l*c,i*c,c],32),this.memory.write(this.view,h),this.memory.write(this.state,Z);let m=n.createCommandEncoder(),p=m.beginComputePass();x(p,a.project,this.project,Math.ceil(o/g)),this.sorter.run(p),p.end();let y=this.pictureOf(r.width,r.height);this.render(m,y.createView(),a.draw,this.splats,d=>d.drawIndirect(this.state,ce)),this.render(m,this.context.getCurrentTexture().createView(),a.screen,this.screen,d=>d.draw(3)),n.queue.submit([m.finish()])}dispose(){this.picture?.destroy(),this.memory.free()}render(e,r,t,a,o){let n=e.beginRenderPass({colorAttachments:[{view:r,loadOp:"clear",storeOp:"store"}]});n.setPipeline(t),n.setBindGroup(0,a),o(n),n.end()}pictureOf(e,r){let{pipelines:t}=this,{device:a}=t;if(this.picture?.width===e&&this.picture.height===r)return this.picture;this.picture?.destroy();let{RENDER_ATTACHMENT:o,TEXTURE_BINDING:n}=GPUTextureUsage,u=this.picture=a.createTexture({size:[e,r],format:Q,usage:o|n});return this.screen=a.createBindGroup({layout:t.screen.getBindGroupLayout(0),entries:[{binding:0,resource:{buffer:this.view}},{binding:1,resource:u.createView()}]}),u}uploadPosed(e,r){let{memory:t,posed:a,means:o,colors:n}=this;G(e.means,o),G(e.colors,n),e.opacityLogits.forEach((u,l)=>n[4*l+3]=u),t.write(a.frames,e.frames),t.write(a.means,o),t.write(a.colors,n),this.uploadShapes(r.quats,r.scales)}uploadShapes(e,r){let{shapeValues:t}=this;for(let a=0;a<this.count;++a){for(let o=0;o<4;++o)t[8*a+o]=e[4*a+o];for(let o=0;o<3;++o)t[8*a+4+o]=r[3*a+o]}this.memory.write(this.shapes,t)}};async function fe(s="auto"){if(s!=="webgl2")try{let e=await he(s),r=e.lost;e.pushErrorScope("validation");let t=new B(e,navigator.gpu.getPreferredCanvasFormat()),a=await e.popErrorScope();if(a)throw new Error(a.message);return(...o)=>new L(t,r,...o)}catch(e){ee(e.message);return}}var ee=s=>console.warn(`mien: ${s}; WebGL2 draws instead`);async function he(s){if(!navigator.gpu)throw new Error("this browser has no WebGPU, or the page has no secure address");let e=await navigator.gpu.requestAdapter({powerPreference:"high-performance"});if(!e)throw new Error("WebGPU has no adapter here");if(s==="auto"&&e.info.isFallbackAdapter)throw new Error("WebGPU has an adapter in software only");let{maxStorageBufferBindingSize:r,maxBufferSize:t}=e.limits;return e.requestDevice({requiredLimits:{maxStorageBufferBindingSize:r,maxBufferSize:t}})}var L=class{constructor(e,r,t,a,o,n,u){this.hidden=new OffscreenCanvas(1,1);this.disposed=!1;this.screen=t.getContext("2d");let l=i=>{ee(i),o.binds=!0,o.activations.fill(NaN);let c=this.hidden=new OffscreenCanvas(1,1);return c.addEventListener("webglcontextlost",f=>f.preventDefault()),c.addEventListener("webglcontextrestored",()=>{this.drawer=new u(c,a,o),n()}),new u(c,a,o)};o.binds=!1;try{this.drawer=new M(e,this.hidden.getContext("webgpu"),a,o)}catch(i){this.drawer=l(`this avatar ${i.message}`);return}r.then(({message:i})=>{this.disposed||(this.drawer=l(`the WebGPU device is lost (${i.trim()||"no reason is given"})`),n())}).catch(i=>console.error(`mien: ${i.message}`))}upload(){this.drawer.upload()}draw(e,r,t){let{hidden:a,screen:o}=this,{width:n,height:u}=r;(a.width!==n||a.height!==u)&&([a.width,a.height]=[n,u]),this.drawer.draw(e,r,t),o.globalCompositeOperation="copy",o.drawImage(a,0,0)}dispose(){this.disposed=!0,this.drawer.dispose()}};return se(de);})();
